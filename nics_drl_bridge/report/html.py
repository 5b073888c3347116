"""HTML pages in one file: light and dark, from a phone's width up, and complete in print."""

import base64
from collections.abc import Sequence
from html import escape

STYLE = """
:root { color-scheme: light dark; --ink: #1f2328; --soft: #57606a; --line: #d9dee4;
  --paper: #fff; --card: #f6f7f9; --good: #00704f; --bad: #b04a00 }
@media screen and (prefers-color-scheme: dark) {
  :root { --ink: #e6e9ed; --soft: #9aa5b1; --line: #343b44; --paper: #14171a;
    --card: #1e2328; --good: #3fc79c; --bad: #ff9a55 }
  img { filter: invert(.91) hue-rotate(180deg) } }
* { box-sizing: border-box }
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 68rem;
  padding: 0 1rem; color: var(--ink); background: var(--paper); overflow-wrap: break-word }
h1 { margin: 0; line-height: 1.2 } h2 { margin: 2.4rem 0 .8rem; line-height: 1.25 }
.lead, figcaption, .tile span { color: var(--soft) }
.tiles { display: grid; gap: 1rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 14rem), 1fr)) }
.tile { background: var(--card); border-left: .3rem solid var(--good); border-radius: .4rem;
  padding: .8rem 1rem; break-inside: avoid }
.tile b { display: block; font-size: 1.9rem; line-height: 1.2; color: var(--good) }
.tile.doubtful { border-color: var(--bad) } .tile.doubtful b { color: var(--bad) }
.scroll, figure { overflow-x: auto }
table { border-collapse: collapse; margin: 1rem 0; font-variant-numeric: tabular-nums }
th, td { padding: .3rem .9rem; text-align: right; border-bottom: 1px solid var(--line) }
th:first-child, td:first-child { text-align: left; padding-left: 0 }
pre { background: var(--card); padding: 1rem; overflow-x: auto; font-size: 13px }
details { border: 1px solid var(--line); border-radius: .4rem; padding: 0 1rem; margin: 1rem 0 }
summary { cursor: pointer; font-weight: 600; padding: .7rem 0 }
figure { margin: 1rem 0; break-inside: avoid }
img { max-width: 100%; height: auto }
@media (max-width: 40rem) { figure.wide img { max-width: none; width: 44rem } }
@media print { body { margin: 0; max-width: none }
  pre { white-space: pre-wrap; font-size: 8pt } th, td { padding: .2rem .5rem }
  details::details-content { content-visibility: visible; height: auto; display: block }
  figure.wide img { max-width: 100%; width: auto } h2 { break-after: avoid } }
"""
WIDE = 700  # width of a picture [pixels] above which a phone scrolls it sideways


def make_page(
    title: str, lead: str, sections: Sequence[tuple[str, Sequence[str]]]
) -> str:
    """Builds a page of sections, each a heading and HTML blocks, below a lead sentence."""
    body = "".join(
        f"<h2>{escape(heading)}</h2>{''.join(blocks)}" for heading, blocks in sections
    )
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{STYLE}</style></head><body><h1>{escape(title)}</h1>"
        f'<p class="lead">{escape(lead)}</p>{body}</body></html>\n'
    )


def make_paragraph(text: str) -> str:
    """Returns a paragraph as HTML."""
    return f"<p>{escape(text)}</p>"


def make_code(text: str) -> str:
    """Returns preformatted text."""
    return f"<pre>{escape(text)}</pre>"


def make_bullets(sentences: Sequence[str]) -> str:
    """Returns sentences as a list."""
    return "<ul>" + "".join(f"<li>{escape(text)}</li>" for text in sentences) + "</ul>"


def make_tiles(figures: Sequence[tuple[str, str, bool]]) -> str:
    """Returns figures in large type, each with its meaning and False if it raises a doubt."""
    tiles = (
        f'<div class="tile{"" if good else " doubtful"}"><b>{"" if good else "⚠ "}{escape(figure)}'
        f"</b><span>{escape(meaning)}</span></div>"
        for figure, meaning, good in figures
    )
    return f'<div class="tiles">{"".join(tiles)}</div>'


def make_picture(png: bytes, caption: str) -> str:
    """Returns a PNG with its caption."""
    data = base64.b64encode(png).decode()
    caption = escape(caption)
    kind = ' class="wide"' if _read_width(png) > WIDE else ""
    return (
        f'<figure{kind}><img src="data:image/png;base64,{data}" alt="{caption}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _read_width(png: bytes) -> int:
    """Returns the width of a PNG [pixels]."""
    return int.from_bytes(png[16:20], "big")


def make_details(summary: str, blocks: Sequence[str]) -> str:
    """Returns blocks folded below a summary, which are open in print."""
    return f"<details><summary>{escape(summary)}</summary>{''.join(blocks)}</details>"


def make_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Returns rows of text under a heading row."""

    def cells(kind: str, row: Sequence[str]) -> str:
        return (
            "<tr>"
            + "".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in row)
            + "</tr>"
        )

    body = "".join(cells("td", row) for row in rows)
    head_row = f"<thead>{cells('th', head)}</thead>"
    return f'<div class="scroll"><table>{head_row}<tbody>{body}</tbody></table></div>'
