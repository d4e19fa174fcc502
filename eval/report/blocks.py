"""What a report is made of, and how each piece is written in Markdown, HTML and LaTeX."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from dataclasses import dataclass

from eval.tables import table


@dataclass(frozen=True)
class Heading:
    """A heading of level 1 to 3."""

    text: str
    level: int = 2


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str


@dataclass(frozen=True)
class Table:
    """A table; `caption` says n, runs, seeds and what is in the cells."""

    header: Sequence[str]
    body: Sequence[Sequence[str]]
    caption: str


@dataclass(frozen=True)
class Figure:
    """A picture, kept as SVG and PNG under its name; `caption` says n, runs, seeds and what bars and bands are."""

    name: str
    svg: str
    png: bytes
    caption: str


Block = Heading | Text | Table | Figure

STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2, h3 { line-height: 1.2; margin-top: 2.2rem; }
table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.3rem 0.6rem; border-bottom: 1px solid #ccc; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
th { border-bottom: 2px solid #555; }
.wide { overflow-x: auto; margin: 1rem 0; }
figure { margin: 1.5rem 0; break-inside: avoid; }
figure svg { max-width: 100%; height: auto; }
figcaption, .caption { font-size: 0.85rem; color: #444; margin: 0.4rem 0; }
nav { font-size: 0.9rem; columns: 2; }
@media print { body { max-width: none; font-size: 10pt; margin: 0; } nav { display: none; } .wide { overflow: visible; }
  table { break-inside: avoid; font-size: 8pt; } th, td { white-space: normal; } }
"""


def to_markdown(blocks: Sequence[Block]) -> str:
    """GitHub's Markdown; figures are the PNG files beside it."""
    parts = []
    for block in blocks:
        match block:
            case Heading(text, level):
                parts.append(f"{'#' * level} {text}")
            case Text(text):
                parts.append(text)
            case Table(header, body, caption):
                parts.append("\n".join(table(header, body)))
                parts.append(f"*{caption}*")
            case Figure(name, _, _, caption):
                parts.append(f"![{caption}](figures/{name}.png)")
                parts.append(f"*{caption}*")
    return "\n\n".join(parts) + "\n"


def to_html(blocks: Sequence[Block], title: str) -> str:
    """One self-contained page: no script, nothing fetched; readable in print."""
    sections = [b for b in blocks if isinstance(b, Heading) and b.level == 2]
    nav = "".join(f'<a href="#{_anchor(b.text)}">{html.escape(b.text)}</a><br>' for b in sections)
    body = "\n".join(_html(block) for block in blocks)
    head, _, rest = body.partition("</h1>")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head>\n'
        f"<body>{head}</h1><nav>{nav}</nav>{rest}</body></html>\n"
    )


def _html(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f'<h{level} id="{_anchor(text)}">{html.escape(text)}</h{level}>'
        case Text(text):
            return f"<p>{_inline(text)}</p>"
        case Table(header, body, caption):
            head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
            rows = "".join(f"<tr>{''.join(f'<td>{html.escape(c)}</td>' for c in row)}</tr>" for row in body)
            table_html = f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
            return f'<div class="wide">{table_html}<p class="caption">{html.escape(caption)}</p></div>'
        case Figure(_, svg, _, caption):
            drawing = svg[svg.index("<svg") :]
            alt = html.escape(caption, quote=True)
            drawing = drawing.replace("<svg ", f'<svg role="img" aria-label="{alt}" ', 1)
            return f"<figure>{drawing}<figcaption>{html.escape(caption)}</figcaption></figure>"


def to_latex(blocks: Sequence[Block]) -> str:
    """Tables (booktabs) and figures for a paper; needs `\\usepackage{booktabs,graphicx}`."""
    parts = []
    for block in blocks:
        match block:
            case Heading(text, level):
                parts.append(f"\\{('section', 'subsection', 'subsubsection')[level - 1]}*{{{_tex(text)}}}")
            case Text(text):
                parts.append(_tex(text.replace("`", "")))
            case Table(header, body, caption):
                lines = [" & ".join(map(_tex, row)) + r" \\" for row in body]
                columns = "l" + "r" * (len(header) - 1)
                inner = [
                    r"\toprule",
                    " & ".join(map(_tex, header)) + r" \\",
                    r"\midrule",
                    *lines,
                    r"\bottomrule",
                ]
                tabular = "\n".join([f"\\begin{{tabular}}{{{columns}}}", *inner, r"\end{tabular}"])
                wrapped = f"\\resizebox{{\\linewidth}}{{!}}{{{tabular}}}" if len(header) > 6 else tabular
                parts.append(
                    f"\\begin{{table}}[ht]\\centering\n{wrapped}\n\\caption{{{_tex(caption)}}}\n\\end{{table}}"
                )
            case Figure(name, _, _, caption):
                image = f"\\includegraphics[width=\\linewidth]{{figures/{name}.png}}"
                parts.append(
                    f"\\begin{{figure}}[ht]\\centering\n{image}\n\\caption{{{_tex(caption)}}}\n\\end{{figure}}"
                )
    return "\n\n".join(parts) + "\n"


def _anchor(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def _inline(text: str) -> str:
    """Escaped, with `code` set as code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))


_TEX = {
    "\\": r"\textbackslash{}",
    "–": "--",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
} | {c: f"\\{c}" for c in "&%$#_{}"}


def _tex(text: str) -> str:
    """Text with LaTeX's special characters escaped.

    >>> _tex("profit ($/h) & 5 %")
    'profit (\\\\$/h) \\\\& 5 \\\\%'
    """
    return "".join(_TEX.get(c, c) for c in text)
