"""Puts the pages that scripts make where the site finds them, and leads links to the pages of the site."""

import json
import re
from pathlib import Path

from sphinx.application import Sphinx

from generate import catalogue, reference

# Files beside `docs/` that have a page of their own here.
PAGES = {
    "../CONTRIBUTING.md": "contributing.md",
    "../CHANGELOG.md": "changelog.md",
    "../rotflex_jax/effects/base.py": "reference/rotflex_jax_effects_base.rst",
}


def write(folder: Path, pages: dict[str, str]) -> None:
    """Write pages into a folder that holds nothing else; what has not changed keeps its date."""
    folder.mkdir(exist_ok=True)
    for old in {p.name for p in folder.iterdir()} - set(pages):
        (folder / old).unlink()
    for name, text in pages.items():
        file = folder / name
        if not file.exists() or file.read_text(encoding="utf-8") != text:
            file.write_text(text, encoding="utf-8")


def write_all(app: Sphinx) -> None:
    """The catalogue of effects, the reference, and the notebooks as they were run."""
    source = Path(app.srcdir)
    # Kept in the repository, where a code host shows it.
    (source / "catalogue.md").write_text(catalogue.overview(), encoding="utf-8")
    run = sorted((source.parent / "notebooks").glob("*.ipynb"))
    write(source / "notebooks", {file.name: _described(file.read_text(encoding="utf-8")) for file in run})
    write(source / "effects", catalogue.pages())
    write(source / "reference", reference.pages())


def _described(notebook: str) -> str:
    """A notebook whose figures say, to those who cannot see them, which section they belong to."""
    content, heading = json.loads(notebook), ""
    for cell in content["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            heading = (re.findall(r"^#+ (.+)$", text, re.MULTILINE) or [heading])[-1]
        else:
            cell["metadata"]["mystnb"] = {"image": {"alt": f"Figure of the section “{heading}”"}}
    return json.dumps(content, indent=1, ensure_ascii=False)


def lead_links(app: Sphinx, page: str, content: list[str]) -> None:
    """A link to a file beside `docs/` goes to its page; on a code host it stays a link to the file."""
    if page == "catalogue":
        content[0] = catalogue.overview(on_site=True)
    if page.startswith("notebooks/"):
        content[0] = content[0].replace("](../docs/", "](../")
        for file, target in PAGES.items():
            content[0] = content[0].replace(f"]({file}", f"](../{target}")
        return
    content[0] = content[0].replace("](../notebooks/", "](notebooks/")
    for file, target in PAGES.items():
        content[0] = content[0].replace(f"]({file}", f"]({target}")
    # Anything else outside is a file to look at, not a page.
    content[0] = re.sub(r"\]\((\.\./[^)#]+\.md)\)", r"](path:\1)", content[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Enter both steps."""
    app.connect("builder-inited", write_all)
    app.connect("source-read", lead_links)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
