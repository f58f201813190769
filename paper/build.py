"""From results to PDF: numbers into the text, figures, supplement, all set in `build/`.

    pip install "rotflex_jax[paper]" && python paper/build.py

Pandoc turns the Markdown into Typst, citations included, and Typst sets it. Journals that take the Markdown
itself take `paper.md`, `paper.bib` and `figures/`.
"""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pypandoc
import typst

HERE = Path(__file__).resolve().parent
BUILD = HERE / "build"

PAGE = """#set page(paper: "a4", margin: {margin}, flipped: {flipped}, numbering: "1")
#set text(size: {size}pt, lang: "en")
#set par(justify: true)
#show heading: set block(above: 1.4em, below: 0.8em)
#show figure: set block(breakable: true)
#set table(stroke: none, inset: 3pt)
#show table.cell.where(y: 0): strong
#let horizontalrule = line(length: 100%)
"""
TITLE = """#align(center)[#text(size: 15pt, weight: "bold")[{title}]

{authors}
]
"""


def body(text: str) -> str:
    """Markdown as Typst, without its front matter; references to figures by their number."""
    order = re.findall(r'\[\]\{label="(\w+)"\}', text)
    text = re.sub(r' ?\[\]\{label="\w+"\}', "", text)
    text = re.sub(r"\\autoref\{(\w+)\}", lambda m: f"Figure {order.index(m[1]) + 1}", text)
    return pypandoc.convert_text(
        text,
        "typst",
        format="markdown-tex_math_dollars" if "$" not in text else "markdown",
        extra_args=["--citeproc", f"--bibliography={HERE / 'paper.bib'}", "--wrap=none"],
    )


def front(text: str, key: str) -> str:
    """One line of the front matter."""
    found = re.search(rf"^{key}: '?(.*?)'?$", text, re.MULTILINE)
    return found[1] if found else ""


def typeset(source: Path, name: str, authors: str, size: float, flipped: bool) -> None:
    """One Markdown file as a PDF in `build/`."""
    text = source.read_text(encoding="utf-8")
    title = front(text, "title").replace("_", r"\_")
    margin = "1.6cm" if flipped else "2.2cm"
    page = PAGE.format(margin=margin, flipped="true" if flipped else "false", size=size)
    whole = page + TITLE.format(title=title, authors=authors) + body(text)
    # Paths of figures are meant from the folder of the paper.
    (HERE / "build" / f"{name}.typ").write_text(whole.replace('"figures/', '"/figures/'), encoding="utf-8")
    typst.compile(str(BUILD / f"{name}.typ"), output=str(BUILD / f"{name}.pdf"), root=str(HERE))


def main() -> None:
    """Everything, in order."""
    for folder in (BUILD, HERE / "figures"):
        folder.mkdir(exist_ok=True)
    subprocess.run([sys.executable, str(HERE.parent / "benchmarks" / "quoted.py")], check=True)
    sys.path.insert(0, str(HERE / "scripts"))
    for script in (*sorted((HERE / "scripts").glob("fig_*.py")), HERE / "scripts" / "supplement.py"):
        print(script.name, flush=True)
        runpy.run_path(str(script), run_name="__main__")
    authors = "The rotflex_jax developers".replace("_", r"\_")
    typeset(HERE / "paper.md", "paper", authors, 10, flipped=False)
    typeset(BUILD / "supplement.md", "supplement", authors, 7, flipped=True)
    print(f"{BUILD / 'paper.pdf'}\n{BUILD / 'supplement.pdf'}")


if __name__ == "__main__":
    main()
