// Without a mathematical font on the reader's machine some browsers leave subscripts on the line.
document.addEventListener("DOMContentLoaded", () => {
  if (!document.querySelector("math")) return;
  const probe = document.createElement("span");
  probe.innerHTML = "<math><msub><mi>n</mi><mi>n</mi></msub></math>";
  document.body.append(probe);
  const [base, index] = [...probe.querySelectorAll("mi")].map((part) => part.getBoundingClientRect());
  const low = index.top + index.height / 2 - (base.top + base.height / 2);
  document.documentElement.classList.toggle("no-math-font", low < 0.25 * base.height);
  probe.remove();
});
