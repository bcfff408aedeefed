"""`python -m mjx_grasp`: which commands there are."""

import ast
from pathlib import Path


def commands() -> dict[str, str]:
    """What each command is for, by what is typed: the first lines of their files."""
    root = Path(__file__).parent
    said = {}
    for file in sorted([*root.glob("*.py"), *root.glob("*/*.py")]):
        first = (ast.get_docstring(ast.parse(file.read_text())) or "").partition("\n")[0]
        typed, _, purpose = first.partition("`: ")
        if typed.startswith("`python -m mjx_grasp.") and purpose:
            said[typed[1:]] = purpose
    return said


if __name__ == "__main__":
    for typed, purpose in commands().items():
        print(f"{typed}\n    {purpose}")
    print("Each of them says more with --help.")
