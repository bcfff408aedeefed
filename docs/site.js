// Without a mathematical font on the reader's machine some browsers set subscripts on the line.
document.addEventListener("DOMContentLoaded", () => {
  const base = document.querySelector("math msub");
  if (!base) return;
  const [what, index] = [...base.children].map((part) => part.getBoundingClientRect());
  const low = index.top + index.height / 2 - (what.top + what.height / 2);
  document.documentElement.classList.toggle("no-math-font", low < 0.12 * what.height);
});
