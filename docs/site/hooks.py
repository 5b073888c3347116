"""Hooks of the site: pages that are made of the code, of notebooks and of files beside docs/."""

import base64
import re
from pathlib import Path, PurePosixPath
from posixpath import normpath, relpath
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "nics_drl_bridge"
AT_THE_TOP = ("CHANGELOG.md", "CONTRIBUTING.md")
# The theme's for pages on disk would be loaded from elsewhere: ours takes its place.
SHIM = re.compile(r"<script[^>]*unpkg\.com/iframe-worker[^>]*></script>")
NAMED = re.compile(r"(?<!\[)`docs/(?P<page>[\w/]+\.md)`")
FROM_DISK = (
    f"<script>{Path(__file__).with_name('search_from_disk.js').read_text()}</script>"
)
DISPLAYED_FORMULA = re.compile(r"^\$\$\n(?P<tex>.+?)\n\$\$$", re.MULTILINE | re.DOTALL)
INLINE_FORMULA = re.compile(r"(?<![\w$`])\$(?P<tex>[^$`\n]+)\$(?![\w$`])")
EQUATION_NUMBER = re.compile(r"\\tag\{(\d+)\}")
CODE = re.compile(r"(^```.*?^```|`[^`\n]*`)", re.MULTILINE | re.DOTALL)
TABLE_CELL = re.compile(r"<td\b.*?</td>", re.DOTALL)
CODE_IN_HTML = re.compile(r"<code>(?P<text>[^<]*)</code>")
JOINT = re.compile(r"(?<=[_/.:])(?=\w)")  # between two parts of a name
LINK = re.compile(r"\[(?P<text>[^\]]*)\]\((?P<to>[^)#\s:]+)(?P<anchor>#[^)]*)?\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Lists the pages of the package's rooms in place of `api/`."""
    for tab in config.nav or ():
        for entry in tab.get("Reference", ()) if isinstance(tab, dict) else ():
            if entry.get("Python") == "api/":
                entry["Python"] = [{room: f"api/{room}.md"} for room in rooms()]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds what is no page of docs/ by itself."""
    made: dict[str, str | bytes] = {
        f"api/{room}.md": api_page(room) for room in rooms()
    }
    made |= {name: (ROOT / name).read_text(encoding="utf-8") for name in AT_THE_TOP}
    for notebook in sorted(Path(config.docs_dir).glob("notebooks/*.ipynb")):
        made |= notebook_pages(notebook)
    for name, content in made.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(
    markdown: str, page: Any, config: MkDocsConfig, files: Files
) -> str:
    """Makes links of the pages that a text names, and plain text of links that leave docs/."""
    here = str(PurePosixPath(page.file.src_uri).parent)

    def named(match: re.Match[str]) -> str:
        to = match["page"]
        found = files.get_file_from_path(to) is not None
        return f"[{match[0]}]({relpath(to, here)})" if found else match[0]

    def within(match: re.Match[str]) -> str:
        leaves = normpath(f"{here}/{match['to']}").startswith("..")
        return match["text"] if leaves else match[0]

    return LINK.sub(within, NAMED.sub(named, with_formulas(markdown)))


def with_formulas(markdown: str) -> str:
    """Replaces LaTeX between dollar signs by MathML, which browsers draw without scripts."""
    markdown = DISPLAYED_FORMULA.sub(displayed_formula, markdown)
    parts = CODE.split(markdown)
    for index in range(0, len(parts), 2):  # every other part is code
        parts[index] = INLINE_FORMULA.sub(inline_formula, parts[index])
    return "".join(parts)


def inline_formula(match: re.Match[str]) -> str:
    """A formula within a sentence.

    Markdown takes `<math>` at the beginning of a line for a block, which would break the sentence
    into paragraphs; `<span>` it leaves in its place.
    """
    return f'<span class="formula">{convert(match["tex"])}</span>'


def displayed_formula(match: re.Match[str]) -> str:
    """A formula on lines of its own, with the number of its equation."""
    number = EQUATION_NUMBER.search(match["tex"])
    formula = convert(EQUATION_NUMBER.sub("", match["tex"]).strip(), display="block")
    label = f'<span class="equation-number">({number[1]})</span>' if number else ""
    return f'<div class="equation"><div class="equation-formula">{formula}</div>{label}</div>\n'


def on_post_page(output: str, page: Any, config: MkDocsConfig) -> str:
    """Lets pages on disk be searched, too, and names in tables be broken at their joints."""
    return with_break_points(SHIM.sub(lambda _: FROM_DISK, output))


def with_break_points(html: str) -> str:
    """Lets a browser break names in table cells behind `_`, `/`, `.` and `:`, and only there."""

    def within_code(code: re.Match[str]) -> str:
        return f"<code>{JOINT.sub('<wbr>', code['text'])}</code>"

    return TABLE_CELL.sub(lambda cell: CODE_IN_HTML.sub(within_code, cell[0]), html)


def on_post_template(
    output_content: str, template_name: str, config: MkDocsConfig
) -> str:
    """Lets pages on disk be searched, too."""
    return SHIM.sub(lambda _: FROM_DISK, output_content)


def rooms() -> list[str]:
    """The rooms of the package, the modules at its top first."""
    return ["top", *sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))]


def api_page(room: str) -> str:
    """The page of a room: all its modules but the kernels."""
    folder = PACKAGE if room == "top" else PACKAGE / room
    modules = sorted(folder.glob("*.py") if room == "top" else folder.rglob("*.py"))
    kept = [
        m
        for m in modules
        if not m.stem.endswith("kernels") and not m.stem.startswith("_")
    ]
    names = [".".join(m.relative_to(ROOT).with_suffix("").parts) for m in kept]
    title = "nics_drl_bridge" if room == "top" else f"nics_drl_bridge.{room}"
    return "\n\n".join([f"# {title}", *(f"::: {name}" for name in names)]) + "\n"


def notebook_pages(path: Path) -> dict[str, str | bytes]:
    """A notebook as a page, with its pictures beside it."""
    text, resources = MarkdownExporter().from_filename(str(path))
    pictures = resources["outputs"]
    folder = f"notebooks/{path.stem}"
    for name in pictures:
        text = text.replace(f"]({name})", f"]({path.stem}/{name})")
    return {f"notebooks/{path.stem}.md": text} | {
        f"{folder}/{name}": data if isinstance(data, bytes) else base64.b64decode(data)
        for name, data in pictures.items()
    }
