"""What of an answer is meant to be seen: without its reasoning blocks, and without the dress of chat formats.

Models think in blocks (`<think>`, `[THINK]`, harmony channels, ...) that are closed, cut off, or opened by the chat
template. Whoever reads an answer, as an action, as data or as words, reads what is `visible` of it; nothing in a block
counts.
"""

from __future__ import annotations

import re

_BLOCKS = "think|thinking|thoughts?|reasoning|reason|reflection|analysis|scratchpad|inner_monologue"
_BLOCK = re.compile(rf"<(/?)(?:{_BLOCKS})\b[^<>]*>|\[(/?)THINK\]|◁(/?)think▷", re.IGNORECASE)
_FINAL = re.compile(r"<\|channel\|>\s*final\s*<\|message\|>")
_TOOL = re.compile(r"<\|channel\|>\s*commentary\s+(?=to=)")
_TOKEN = re.compile(r"<\|[^<>|]{1,40}\|>|</s>|<end_of_turn>|<eos>")
_AS_LABEL = re.compile(r"<(action|answer|final_answer|command)>(.*?)(?:</\1>|$)", re.IGNORECASE | re.DOTALL)
_BOXED = re.compile(r"\\boxed\{([^{}]*)\}")
_SIGNS = str.maketrans(
    {"“": '"', "”": '"', "‘": "'", "’": "'", "（": "(", "）": ")", "：": ":", "−": "-", "\u00a0": " ", "\u200b": ""}
)


def visible(text: str) -> tuple[str, bool]:
    """`text` without reasoning blocks, and whether one of them was never closed."""
    if "<|channel|>" in text:
        parts = _FINAL.split(text)
        tool = _TOOL.search(text)
        if len(parts) == 1 and tool is None:
            return "", True
        text = parts[-1] if len(parts) > 1 else text[tool.end() :] if tool else ""
    kept: list[str] = []
    depth = at = 0
    for match in _BLOCK.finditer(text):
        closes = "/" in (match.group(1) or "", match.group(2) or "", match.group(3) or "")
        if not closes:
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
    text = text.translate(_SIGNS).replace("\\_", "_")
    text = _AS_LABEL.sub(lambda m: f"\nAction: {m.group(2).strip()}\n", text)
    return _BOXED.sub(lambda m: f"\nAction: {m.group(1)}\n", text).strip()
