"""Links and pictures that leave docs/: to the repository if pyproject.toml states its address, else shown as paths.

``[study](../experiments/units)`` is a link on GitHub, but no page of the site. A target is looked for from the page
and from the repository's root, since pages include files that lie there. Sphinx warns of one that does not exist.
"""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def repository() -> str:
    """Return the address of the repository's files; empty if none is stated."""
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"].get("urls", {})
    return f"{urls['Repository'].rstrip('/')}/blob/main" if "Repository" in urls else ""


def find(target: str, page: Path) -> Path | None:
    """Return the file or folder of the repository that a page's link names; None if there is none."""
    places = (Path(os.path.normpath(folder / target)) for folder in (page.parent, ROOT))
    return next((each for each in places if target and each.exists() and each.is_relative_to(ROOT)), None)


class RepositoryLinks(SphinxTransform):
    """Finds what relative links of Markdown name if they name no page."""

    default_priority = 5  # before files are gathered and references resolved

    def apply(self, **_: Any) -> None:
        """Change the pictures and links of a page."""
        page = DOCS / self.env.docname
        for picture in self.document.findall(nodes.image):
            if path := find(picture["uri"], page):
                picture["uri"] = os.path.relpath(path, page.parent)
        for link in list(self.document.findall(addnodes.pending_xref)):
            if link["reftype"] != "myst":
                continue
            target, _, anchor = link["reftarget"].partition("#")
            if link["refdomain"] == "doc" and target.startswith("/"):  # a Markdown file that is no page
                target += ".md"
            elif link["refdomain"] == "doc":
                continue
            if path := find(target, page):
                self.lead(link, path, anchor)
        for link in list(self.document.findall(addnodes.download_reference)):
            if path := find(link["reftarget"], page):
                self.lead(link, path)

    def lead(self, link: nodes.Element, path: Path, anchor: str = "") -> None:
        """Let a link lead to a page, to the repository, or to nothing but the path of a file."""
        name = path.relative_to(ROOT).as_posix()
        if path.is_relative_to(DOCS) and path.suffix == ".md":
            link["refdomain"], link["reftarget"] = "doc", path.relative_to(DOCS).with_suffix("").as_posix()
            link["reftargetid"] = anchor or None
        elif address := repository():
            link.replace_self(nodes.reference("", "", *link.children, refuri=f"{address}/{name}"))
        else:
            siblings = link.parent.children
            before = siblings[position - 1].astext() if (position := siblings.index(link)) else ""
            inside = before.endswith("(")  # of brackets
            around = (", ", "") if inside else (" (", ")")
            shown = nodes.literal("", name, classes=["repository-path"])
            words = [*link.children, nodes.Text(around[0]), shown, nodes.Text(around[1])]
            link.replace_self([shown] if link.astext().rstrip("/") == name else words)


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the transform."""
    app.add_transform(RepositoryLinks)
    return {"parallel_read_safe": True}
