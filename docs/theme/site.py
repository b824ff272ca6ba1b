"""Make pages of what lies outside docs/: README, changelog, and every source that a page links to (an MkDocs hook).

Documents link to each other and to sources by their place in the repository, as a reader of the checkout follows them.
Here those links are turned to the pages made of these files, so that the same text serves both.
"""

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PAGES = {"README.md": "overview.md", "CHANGELOG.md": "changelog.md", "benchmarks/README.md": "measuring.md"}
"""Documents outside docs/, by their place in the repository: the pages made of them."""
FRONT = "README.md"
FIRST_PART = "<!-- README: first part -->"
"""Where docs/index.md shows what README.md says before its first section."""
LANGUAGES = {".py": "python", ".pyi": "python", ".h": "cpp", ".cpp": "cpp", ".cu": "cpp", ".toml": "toml"}
LINK = re.compile(r"(?<=\]\()(?!https?:|mailto:|#)([^)\s#]+)(#[^)\s]*)?(?=\))")
FENCE = re.compile(r"(^```.*?^```)", re.MULTILINE | re.DOTALL)


def place_of(page: str) -> str:
    """Return the place in the repository of what a page of the site is made of."""
    places = {made: place for place, made in PAGES.items()}
    return places.get(page) or (page.removeprefix("source/").removesuffix(".md") if is_source(page) else f"docs/{page}")


def page_of(place: str) -> str:
    """Return the page (or file) of the site that shows a file or folder of the repository."""
    if place in PAGES:
        return PAGES[place]
    return place.removeprefix("docs/") if place.startswith("docs/") else f"source/{place.rstrip('/')}.md"


def is_source(page: str) -> bool:
    """Tell whether a page shows a source as it is."""
    return page.startswith("source/")


def links(text: str, place: str) -> Iterator[str]:
    """Yield where in the repository the links of a document at `place` lead; code in it has none."""
    for part in FENCE.split(text)[::2]:
        yield from (_joined(place, match[1]) for match in LINK.finditer(part))


def relinked(text: str, place: str, page: str) -> str:
    """Return a document at `place` with its links made relative to `page`, and leading to the site's pages.

    The README without a heading is the front page: it says there what it says here.
    """

    def link(match: re.Match[str]) -> str:
        target = _joined(place, match[1])
        shown = "index.md" if target == FRONT and not match[2] else page_of(target)
        return posixpath.relpath(shown, posixpath.dirname(page) or ".") + (match[2] or "")

    parts = FENCE.split(text)
    parts[::2] = [LINK.sub(link, part) for part in parts[::2]]
    return "".join(parts)


def _joined(place: str, target: str) -> str:
    return posixpath.normpath(posixpath.join(posixpath.dirname(place), target))


def first_part(readme: str) -> str:
    """Return what the README says under its title and before its first section."""
    return readme.partition("\n## ")[0].partition("\n")[2].strip()


def overview(readme: str) -> str:
    """Return the README's sections under a title: the front page shows the part before them."""
    return f"# Overview\n\n## {readme.partition(chr(10) + '## ')[2]}"


def source_page(path: Path) -> str:
    """Write a page that shows a file as it is, or what a folder holds; search leaves it out."""
    place = path.relative_to(ROOT).as_posix()
    head = f"---\ntitle: {path.name}\nhide: [navigation, toc]\nsearch:\n  exclude: true\n---\n\n# {place}\n\n"
    if path.is_dir():
        return head + "".join(f"- [{file.name}]({path.name}/{file.name}.md)\n" for file in shown_files(path))
    return f"{head}````{LANGUAGES.get(path.suffix, 'text')}\n{path.read_text(encoding='utf-8').rstrip()}\n````\n"


def shown_files(folder: Path) -> list[Path]:
    """List the texts that lie in a folder."""
    return sorted(file for file in folder.iterdir() if file.is_file() and file.suffix in LANGUAGES)


def sources() -> dict[str, str]:
    """Return the pages made of sources that documents link to, and of what lies in the folders among these."""
    documents = [*(ROOT / place for place in PAGES), *sorted((ROOT / "docs").rglob("*.md"))]
    linked = {
        ROOT / target
        for path in documents
        for target in links(path.read_text(encoding="utf-8"), path.relative_to(ROOT).as_posix())
        if is_source(page_of(target)) and (ROOT / target).exists()
    }
    inside = {file for folder in linked if folder.is_dir() for file in shown_files(folder)}
    return {page_of(path.relative_to(ROOT).as_posix()): source_page(path) for path in linked | inside}


def fetched(html: str) -> list[str]:
    """List what a page would load from elsewhere when it is opened: scripts, styles, pictures, frames."""
    loads = r"<(?:script|link|img|iframe|video|source)\b[^>]*?\b(?:src|href)=[\"']?((?:https?:)?//[^\s\"'>]+)"
    return re.findall(loads, html)


def present(nav: Any, pages: set[str]) -> Any:
    """Return a navigation without the pages that are not there."""
    if isinstance(nav, dict):
        return {title: present(entry, pages) for title, entry in nav.items()}
    if isinstance(nav, list):
        kept = (present(entry, pages) for entry in nav)
        return [entry for entry in kept if entry and not (isinstance(entry, dict) and not any(entry.values()))]
    return nav if nav in pages else None


def on_config(config: Any) -> Any:
    """Leave pages out of the navigation that are not written yet."""
    docs = Path(config.docs_dir)
    pages = {*PAGES.values(), *(path.relative_to(docs).as_posix() for path in docs.rglob("*.md"))}
    config.nav = present(config.nav, pages)
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages made of files outside docs/."""
    from mkdocs.structure.files import File, InclusionLevel

    for place, page in PAGES.items():
        text = (ROOT / place).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=overview(text) if place == FRONT else text))
    for page, text in sources().items():
        files.append(File.generated(config, page, content=text, inclusion=InclusionLevel.NOT_IN_NAV))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turn a page's links to pages of the site; fill the front page from the README."""
    uri = page.file.src_uri
    if is_source(uri):
        return markdown
    if FIRST_PART in markdown:
        said = relinked(first_part((ROOT / FRONT).read_text(encoding="utf-8")), FRONT, uri)
        return relinked(markdown, place_of(uri), uri).replace(FIRST_PART, said)
    return relinked(markdown, place_of(uri), uri)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """Refuse a page that would load something from elsewhere."""
    from mkdocs.exceptions import PluginError

    if found := fetched(output):
        raise PluginError(f"{page.file.src_uri} would load {', '.join(found)}; put it into docs/ or leave it out")
    return output
