"""What of an answer is meant to be seen: without its reasoning blocks, and without the dress of chat formats.

Models think in blocks (`<think>`, `[THINK]`, harmony channels, ...) that are closed, cut off, or opened by the chat
template. Whoever reads an answer, as an action, as data or as words, reads what is `visible` of it; nothing in a block
counts.
"""

from __future__ import annotations

import re

LONGEST = 50_000
"""Signs of an answer that are read: of a longer one the beginning and the end, half each."""

_BLOCKS = "think|thinking|thoughts?|reasoning|reason|reflection|analysis|scratchpad|inner_monologue|antthinking"
_BLOCK = re.compile(rf"<(/?)(?:\w+:)?(?:{_BLOCKS})\b[^<>]*>|\[(/?)THINK\]|◁(/?)think▷", re.IGNORECASE)
_OTHER_BLOCKS = (
    (re.compile(r"<\|begin_of_thought\|>"), re.compile(r"<\|end_of_thought\|>")),
    (re.compile(r"<\|START_THINKING\|>"), re.compile(r"<\|END_THINKING\|>")),
    (re.compile(r"<\|channel>thought\b"), re.compile(r"<channel\|>")),
)
_FINAL = re.compile(r"<\|channel\|>\s*final\s*<\|message\|>")
_BARE_FINAL = re.compile(r"\Aanalysis(?=[A-Z\W]).*?assistantfinal", re.DOTALL)
"""Harmony channels whose marks a server has dropped."""
_TOOL = re.compile(r"<\|channel\|>\s*commentary\s+(?=to=)")
_TOKEN = re.compile(r"<\|[^<>|]{1,40}\|>|</s>|<end_of_turn>|<eos>")
_ASIDE = re.compile(
    r"<(plan|planning|notes?|observation|memory|examples?|alternatives|considered|options|summary|internal|context|"
    r"history|state|steps)>.*?</\1>",
    re.IGNORECASE | re.DOTALL,
)
"""Blocks beside an answer whose actions are not the one that is meant."""
_STRUCK = re.compile(r"(?<!~)~~(?!~)[^~\n]+~~(?!~)")
_AS_LABEL = re.compile(r"<(action|answer|final_answer|command)>(.*?)(?:</\1>|$)", re.IGNORECASE | re.DOTALL)
_LATEX = re.compile(r"\\(?:text|texttt|textbf|textsf|mathrm|mathtt|mathbf)\{([^{}]*)\}")
_BOXED = re.compile(r"\\boxed\{([^{}]*)\}")
_QUOTES = str.maketrans(dict.fromkeys("“”„«»「」『』", '"'))
_OBJECT = re.compile(r'[{,]\s*"\w+"\s*:')
_SIGNS = str.maketrans(
    dict.fromkeys("‘’‚", "'")
    | {"（": "(", "）": ")", "：": ":", "，": ",", "−": "-", "\u00a0": " ", "\u202f": " ", "\u200b": ""}
)
_MINUS = re.compile(r"(?<=[\s(,=])[–—](?=\d)")
_TAG = re.compile(
    r"</?(?:b|i|em|strong|code|pre|p|br|span|response|output|result|choice|tool_code)[ \t]*/?>", re.IGNORECASE
)
_RULE = re.compile(r"^[ \t]*\|[^\n]*\n[ \t]*\|(?:[ \t]*:?-+:?[ \t]*\|)+[ \t]*$", re.MULTILINE)
_PRINT = re.compile(r"^[ \t]*print\(([^\n]*)\)[ \t]*$", re.MULTILINE)
_ROW = re.compile(r"^[ \t]*\|([^\n]*)\|[ \t]*$", re.MULTILINE)


def visible(text: str) -> tuple[str, bool]:
    """`text` without reasoning blocks, and whether one of them was never closed."""
    if "<|channel|>" in text:
        parts = _FINAL.split(text)
        tool = _TOOL.search(text)
        if len(parts) == 1 and tool is None:
            return "", True
        text = parts[-1] if len(parts) > 1 else text[tool.end() :] if tool else ""
    text = _BARE_FINAL.sub("", text, count=1)
    for opens, closes in _OTHER_BLOCKS:
        text = closes.sub("</think>", opens.sub("<think>", text))
    kept: list[str] = []
    depth = at = 0
    for match in _BLOCK.finditer(text):
        closing = "/" in (match.group(1) or "", match.group(2) or "", match.group(3) or "")
        if not closing:
            if not depth:
                kept.append(text[at : match.start()])
            depth += 1
        elif depth:
            depth -= 1
        else:
            kept = []  # opened by the chat template: all before it was reasoning
        at = match.end()
    if not depth:
        kept.append(text[at:])
    return _TOKEN.sub("", "".join(kept)).strip(), depth > 0


def undressed(text: str) -> str:
    """Signs and marks of prose made plain: curly quotes, escaped underscores, tags and boxes around an answer."""
    # Quotes within the strings of JSON are none of its own.
    text = text if _OBJECT.search(text) else text.translate(_QUOTES)
    text = _MINUS.sub("-", text.translate(_SIGNS)).replace("\\_", "_")
    text = _LATEX.sub(r"\1", _STRUCK.sub("", _PRINT.sub(r"\1", _ASIDE.sub("", text) if "</" in text else text)))
    # The cells of a table are a list: several actions in it leave open which one is meant.
    text = _ROW.sub(lambda m: "\n".join(f"• {c.strip()}" for c in m[1].split("|")), _RULE.sub("", _TAG.sub("", text)))
    text = _AS_LABEL.sub(lambda m: f"\nAction: {m.group(2).strip()}\n", text)
    return _BOXED.sub(lambda m: f"\nAction: {m.group(1)}\n", text).strip()


def bounded(text: str) -> str:
    """A text that is too long to be read loses its middle."""
    half = LONGEST // 2
    return text if len(text) <= LONGEST else f"{text[:half]}\n{text[-half:]}"
