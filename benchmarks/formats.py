"""The forms in which chat models write an action: what a reader of answers must understand.

Every entry of `FORMATS` takes an action (a call, or a menu entry) and dresses it as some family of models does: labels,
Markdown, remarks, JSON, tool calls, reasoning blocks, invented later turns. `DECOY` stands where an action must *not*
be read: in reasoning, and in what is made up after the answer.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Callable
from typing import Any

Format = Callable[[str, str], str]
"""(action, decoy) -> an answer that means the action."""


def parts(action: str) -> tuple[str, list[Any], dict[str, Any]]:
    """Name, positional and keyword arguments of a call, lengths as texts (`"12m"`); a menu entry is all name."""
    match = re.fullmatch(r"(\w+)\((.*)\)", action, re.DOTALL)
    if match is None:
        return action, [], {}
    tree = ast.parse("f(" + re.sub(r"(?<![\w.\"'])(-?\d+(?:\.\d+)?m)\b", r'"\1"', match[2]) + ")", mode="eval").body
    assert isinstance(tree, ast.Call)
    keywords = {k.arg: ast.literal_eval(k.value) for k in tree.keywords if k.arg}
    return match[1], [ast.literal_eval(a) for a in tree.args], keywords


def _named(action: str, name: str, arguments: str, **around: Any) -> str:
    """A JSON object with the action's name and arguments under the given keys; a menu entry has none."""
    what, args, kwargs = parts(action)
    if what == action or (args and kwargs):
        return json.dumps({**around, name: action})
    return json.dumps({**around, name: what, arguments: kwargs if kwargs and not args else args or {}})


def _keywords_only(action: str) -> bool:
    name, args, _ = parts(action)
    return name != action and not args


def _tool_call(action: str) -> str:
    if not _keywords_only(action):
        return _named(action, "action", "args")
    name, _, kwargs = parts(action)
    function = {"name": name, "arguments": json.dumps(kwargs)}
    return json.dumps({"tool_calls": [{"id": "call_1", "type": "function", "function": function}]})


def _tagged(action: str) -> str:
    """Tags with one parameter each, as Qwen3-Coder writes tool calls."""
    if not _keywords_only(action):
        return f"<action>{action}</action>"
    name, _, kwargs = parts(action)
    values = "".join(
        f"<parameter={k}>\n{v if isinstance(v, str) else json.dumps(v)}\n</parameter>\n" for k, v in kwargs.items()
    )
    return f"<tool_call>\n<function={name}>\n{values}</function>\n</tool_call>"


def _langchain(action: str) -> str:
    if not _keywords_only(action):
        return f"Thought: go on\nAction: {action}"
    name, _, kwargs = parts(action)
    return f"Thought: go on\nAction: {name}\nAction Input: {json.dumps(kwargs)}"


FORMATS: dict[str, Format] = {
    "bare": lambda a, d: a,
    "lower-case": lambda a, d: a[: a.find("(")].lower() + a[a.find("(") :] if "(" in a else a.upper(),
    "full stop": lambda a, d: f"{a}.",
    "leading space": lambda a, d: f"\n\n   {a}\n",
    "label": lambda a, d: f"Action: {a}",
    "small label": lambda a, d: f"action: {a}",
    "capital label": lambda a, d: f"ACTION: {a}",
    "label, next line": lambda a, d: f"Action:\n{a}",
    "label, blank line": lambda a, d: f"Action:\n\n{a}",
    "label without space": lambda a, d: f"Thought: on\nAction:{a}",
    "bold label": lambda a, d: f"**Action:** {a}",
    "bold label, colon outside": lambda a, d: f"**Action**: {a}",
    "bold label and backticks": lambda a, d: f"**Thought:** this pays.\n\n**Action:** `{a}`",
    "all bold": lambda a, d: f"**Action: {a}**",
    "italics": lambda a, d: f"*Action:* *{a}*",
    "heading": lambda a, d: f"### Thought\nThis pays.\n\n### Action\n{a}",
    "heading with fence": lambda a, d: f"## Action:\n```\n{a}\n```",
    "final action": lambda a, d: f"I thought about it.\n\nFinal Action: {a}",
    "next action": lambda a, d: f"Next action: {a}",
    "answer": lambda a, d: f"Let me see.\nAnswer: {a}",
    "final answer": lambda a, d: f"**Final Answer:** {a}",
    "numbered label": lambda a, d: f"Thought 1: this pays\nAction 1: {a}",
    "list item": lambda a, d: f"1. Thought: this pays\n2. Action: {a}",
    "quoted line": lambda a, d: f"> Action: {a}",
    "backticks": lambda a, d: f"`{a}`",
    "bold": lambda a, d: f"**{a}**",
    "quotes": lambda a, d: f'"{a}"',
    "curly quotes": lambda a, d: f"“{a}”",
    "fence": lambda a, d: f"```\n{a}\n```",
    "fence with language": lambda a, d: f"```python\n{a}\n```",
    "prose and fence": lambda a, d: f"I will do this now:\n\n```\n{a}\n```\n",
    "label and fence": lambda a, d: f"Action:\n```text\n{a}\n```",
    "numbering": lambda a, d: f"1. {a}",
    "bullet": lambda a, d: f"- {a}",
    "remark in brackets": lambda a, d: f"{a} (this pays best)",
    "remark after a dash": lambda a, d: f"Action: {a} - this pays best",
    "remark after a long dash": lambda a, d: f"{a} — this pays best",
    "remark after a comment sign": lambda a, d: f"{a}  # this pays best",
    "reason after it": lambda a, d: f"{a}\n\nThis is the best thing to do now because it pays.",
    "prose before it": lambda a, d: f"The board has not been read for a while, so that comes first.\n\n{a}",
    "sentence with code": lambda a, d: f"The best next step is `{a}`, since it pays.",
    "sentence": lambda a, d: f"I will choose {a}.",
    "json": lambda a, d: json.dumps({"action": a}),
    "json with thought": lambda a, d: json.dumps({"thought": "this pays", "action": a}, indent=2),
    "json in a fence": lambda a, d: "```json\n" + json.dumps({"reasoning": "x", "action": a}) + "\n```",
    "json after a label": lambda a, d: "Action: " + json.dumps({"action": a}),
    "json in prose": lambda a, d: f"Here is my decision: {json.dumps({'action': a})} I hope it pays.",
    "json with single quotes": lambda a, d: str({"action": a}),
    "json, name and args": lambda a, d: _named(a, "action", "args"),
    "json, name and arguments": lambda a, d: (
        _named(a, "name", "arguments") if "(" in a else _named(a, "action", "args")
    ),
    "json, tool and input": lambda a, d: _named(a, "tool", "tool_input", thought="this pays"),
    "json of the original benchmark": lambda a, d: json.dumps({"action": {"action_call": a}, "future_plan": "earn"}),
    "openai tool call": lambda a, d: _tool_call(a),
    "hermes tool call": lambda a, d: f"<tool_call>\n{_named(a, 'action', 'arguments')}\n</tool_call>",
    "tags with parameters": lambda a, d: _tagged(a),
    "action tag": lambda a, d: f"<thought>this pays</thought>\n<action>{a}</action>",
    "langchain": lambda a, d: _langchain(a),
    "boxed": lambda a, d: f"So the answer is \\boxed{{{a}}}",
    "think block": lambda a, d: f"<think>\nMaybe\nAction: {d}\nNo.\n</think>\n\n{a}",
    "think block and label": lambda a, d: f"<think>{d}</think>Action: {a}",
    "think block opened by the template": lambda a, d: f"Perhaps {d}\n{d}\n</think>\n\nAction: {a}",
    "thinking block": lambda a, d: f"<thinking>\n{d}\n</thinking>\n{a}",
    "reasoning block": lambda a, d: f"<reasoning>\nAction: {d}\n</reasoning>\nAction: {a}",
    "bracketed think block": lambda a, d: f"[THINK]{d}[/THINK]{a}",
    "harmony channels": lambda a, d: (
        f"<|channel|>analysis<|message|>Action: {d}<|end|><|start|>assistant<|channel|>"
        f"final<|message|>Action: {a}<|return|>"
    ),
    "special token": lambda a, d: f"{a}<|im_end|>",
    "invented observation": lambda a, d: (
        f"Thought: this pays\nAction: {a}\nObservation: done.\nThought: on\nAction: {d}"
    ),
    "invented turn": lambda a, d: f"{a}\nObservation: done.\n{d}",
    "invented user": lambda a, d: f"Action: {a}\n\nUser: well done\n\nAssistant: Action: {d}",
    "two actions": lambda a, d: f"Action: {a}\nAction: {d}",
    "two calls": lambda a, d: f"{a}\n{d}",
    "plan, then label": lambda a, d: f"Plan:\n1. {d}\n2. something else\n\nAction: {a}",
    "prefixed think block": lambda a, d: f"<seed:think>Action: {d}</seed:think>{a}",
    "mixed-case think block": lambda a, d: f"<antThinking>{d}</antThinking>\n{a}",
    "thought marked by tokens": lambda a, d: (
        f"<|begin_of_thought|>Action: {d}<|end_of_thought|><|begin_of_solution|>{a}<|end_of_solution|>"
    ),
    "thought channel": lambda a, d: f"<|channel>thought\nAction: {d}<channel|>{a}",
    "channels without their marks": lambda a, d: f"analysisWe could do {d}. Action: {d}assistantfinal{a}",
    "response tag": lambda a, d: f"<think>{d}</think><response>{a}</response>",
    "html": lambda a, d: f"<b>Action:</b> <code>{a}</code>",
    "guillemets": lambda a, d: f"«{a}»",
    "corner quotes": lambda a, d: f"「{a}」",
    "low quotes": lambda a, d: f"Action: „{a}“",
    "table": lambda a, d: f"| Step | Action |\n|---|---|\n| 1 | {a} |",
    "table of fields": lambda a, d: f"| Field | Value |\n|:--|:--|\n| Reason | it pays |\n| Action | {a} |",
    "politeness": lambda a, d: f"{a}. Happy to help further!",
    "pictograph": lambda a, d: f"{a} ✅",
    "refusal first": lambda a, d: (
        f"I'm sorry, I cannot act in the real world. In this simulation I would choose:\n\n{a}"
    ),
    "json, list of calls": lambda a, d: json.dumps({"actions": [a, d]}),
    "json with typographic quotes": lambda a, d: json.dumps({"thought": "„hot“ food", "action": a}, ensure_ascii=False),
    "json with a comment": lambda a, d: f'{{\n  "action": {json.dumps(a)}, // pays\n  "sure": true\n}}',
    "label in a sentence": lambda a, d: f"Maybe Action: {d} would do,\nbut not now.\nAction: {a}",
}
"""Name of a form -> how it is written."""
