"""Messages -> token ids: the tokenizer's chat template around token ids that are never re-encoded.

A chat template writes text, but a prompt must contain the exact ids a model sampled earlier: encoding their text again
may give other ids, and then neither a KV cache nor a training row fits any more. So the template is rendered with a
placeholder in the place of every assistant turn; the text between the placeholders is tokenised piece by piece, and the
parts of each assistant turn are put in between: literal text encoded on its own, :class:`~agentspec.llm.base.Sampled`
ids verbatim. As the template never sees what the assistant wrote, it cannot strip, trim or rewrite it.

Rules:

- A sampled turn that ends with an end-of-turn token is not given a second one by the template.
- If the last message is the assistant's, its turn is continued: the prompt is that of the messages before it, with the
  generation prompt, followed by the parts of the turn.
- A turn whose first part was sampled keeps the generation prompt it was sampled after, even where the template opens
  past turns in another way (with or without an empty think block, for example).
- Hence appending turns extends the earlier prompt and completion exactly, for every template that writes the turns
  before in the same way again. One that rewrites them gives a prompt that is no extension; nothing else breaks.
- Special tokens in literal content (``<|im_end|>`` in what an environment says) are spelled out as ordinary text:
  content cannot end a turn or open another.
- A template that refuses system turns gets the system text in front of the first user turn.
- A tokenizer without a chat template gets :data:`FALLBACK_TEMPLATE`.
"""

from __future__ import annotations

import re
import weakref
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from agentspec.llm.base import LLMError, Message, Picture, Sampled
from agentspec.llm.pictures import refuse_pictures

FALLBACK_TEMPLATE = (
    "{% for message in messages %}"
    "{{ '### ' + message['role'] | capitalize + '\n' + message['content'] }}"
    "{% if message['role'] == 'assistant' and eos_token %}{{ eos_token }}{% endif %}{{ '\n\n' }}"
    "{% endfor %}"
    "{% if add_generation_prompt %}{{ '### Assistant\n' }}{% endif %}"
)
"""The format of a tokenizer without chat template: ``### Role``, the text, the end-of-sequence token after
assistants."""

# Unicode noncharacters: never part of text, never stripped by a template.
_BREAK = "\ufdd0"
_OPEN, _CLOSE = "\ufdd1", "\ufdd2"
_MARKS = re.compile(f"[{_BREAK}{_OPEN}{_CLOSE}]")
_PLACEHOLDER = re.compile(f"{_OPEN}(\\d+){_CLOSE}")
_CACHED_SEGMENTS = 8192


class ChatFormat:
    """How one tokenizer writes a conversation.

    Args:
        tokenizer: a Hugging Face tokenizer (anything with its ``apply_chat_template`` and ``encode``).
        template_kwargs: variables of the chat template, e.g. ``{"enable_thinking": False}``; by default those that
            :func:`set_template_kwargs` gave the tokenizer.

    Attributes:
        end_of_turn: id of the token that ends an assistant turn, or ``None`` if there is none.
        stop_ids: ids that end a completion: the end of turn and the end of sequence.
    """

    def __init__(self, tokenizer: Any, template_kwargs: Mapping[str, Any] | None = None) -> None:
        self.tokenizer = tokenizer
        self._kwargs = dict(getattr(tokenizer, _KWARGS, {}) if template_kwargs is None else template_kwargs)
        if not getattr(tokenizer, "chat_template", None):
            self._kwargs["chat_template"] = FALLBACK_TEMPLATE
        added = [t for t in getattr(tokenizer, "added_tokens_decoder", {}).values() if t.special and t.content]
        self._special = _alternatives([t.content for t in added])
        # A token that swallows the space beside it must not be cut out of its surroundings.
        self._split = _alternatives([t.content for t in added if not (t.lstrip or t.rstrip or t.single_word)])
        self._segment = lru_cache(maxsize=_CACHED_SEGMENTS)(self._tokenize)
        self._merge_system = not self._accepts_system()
        self._split = self._split if self._splits_exactly() else None
        self._header = self._generation_header()
        eos = tokenizer.eos_token_id
        self.end_of_turn: int | None = self._find_end_of_turn(eos)
        self.stop_ids: frozenset[int] = frozenset(i for i in (self.end_of_turn, eos) if i is not None)

    def render(self, messages: Sequence[Message]) -> list[int]:
        """Token ids of the prompt after which the model writes the next (or the rest of the last) assistant turn.

        Raises:
            LLMError: no message before the assistant's, a picture among them, or the template refuses the conversation.
        """
        refuse_pictures(messages, _name(self.tokenizer))
        continued = messages[-1] if messages and messages[-1].role == "assistant" else None
        turns = messages[:-1] if continued else messages
        if not turns:
            raise LLMError(
                f"a prompt needs a system or user turn first, got {len(messages)} messages; add a user message"
            )
        ids = self._history(turns)
        if continued:
            ids.extend(self._turn(continued))
        return ids

    def encode(self, text: str) -> tuple[int, ...]:
        """Ids of literal content: no special tokens are added, and none is read out of the text."""
        return self._encode_literal(self._escape(text))

    def count_tokens(self, text: str) -> int:
        """Number of ids of ``text``."""
        return len(self.encode(text))

    def _history(self, turns: Sequence[Message]) -> list[int]:
        text = self._apply(self._contents(turns), generate=True)
        pieces = _PLACEHOLDER.split(text)
        ids: list[int] = []
        literals, numbers = pieces[::2], [int(n) for n in pieces[1::2]]
        for i, piece in enumerate(literals):
            turn = turns[numbers[i]] if i < len(numbers) else None
            is_sampled = turn is not None and turn.content and isinstance(turn.content[0], Sampled)
            encoded = self._encode_literal(self._opened(piece) if is_sampled else piece)
            ended = i > 0 and ids and ids[-1] in self.stop_ids and ids[-1:] == list(encoded[:1])
            ids.extend(encoded[1:] if ended else encoded)
            if turn is not None:
                ids.extend(self._turn(turn))
        return ids

    def _turn(self, message: Message) -> list[int]:
        ids: list[int] = []
        for part in message.content:
            if isinstance(part, Sampled) and part.token_ids:
                ids.extend(part.token_ids)
            elif not isinstance(part, Picture):
                ids.extend(self.encode(part.text if isinstance(part, Sampled) else part))
        return ids

    def _contents(self, turns: Sequence[Message]) -> list[dict[str, str]]:
        chat: list[dict[str, str]] = []
        for i, message in enumerate(turns):
            content = f"{_OPEN}{i}{_CLOSE}" if message.role == "assistant" else self._escape(message.text)
            chat.append({"role": message.role, "content": content})
        if self._merge_system and len(chat) > 1 and (chat[0]["role"], chat[1]["role"]) == ("system", "user"):
            first = chat.pop(0)
            chat[0] = {"role": "user", "content": f"{first['content']}\n\n{chat[0]['content']}"}
        return chat

    def _apply(self, chat: list[dict[str, str]], generate: bool) -> str:
        try:
            text = self.tokenizer.apply_chat_template(
                chat, tokenize=False, add_generation_prompt=generate, **self._kwargs
            )
        except Exception as error:  # templates raise whatever they like
            roles = [m["role"] for m in chat]
            raise LLMError(
                f"the chat template of {_name(self.tokenizer)} refuses the turns {roles}: {error}; "
                "most templates expect an optional system turn, then user and assistant in turn"
            ) from error
        assert isinstance(text, str)
        return text

    def _escape(self, text: str) -> str:
        """``text`` with a break inside every special token, and without our own marks."""
        if _MARKS.search(text):
            text = _MARKS.sub("", text)
        if self._special is None:
            return text
        return self._special.sub(lambda m: m[0][:1] + _BREAK + m[0][1:], text)

    def _encode_literal(self, text: str) -> tuple[int, ...]:
        segments = [text] if self._split is None else self._split.split(text)
        if len(segments) == 1 and _BREAK not in text:
            return self._segment(text) if text else ()
        ids: list[int] = []
        for segment in segments:
            for piece in segment.split(_BREAK):
                if piece:
                    ids.extend(self._segment(piece))
        return tuple(ids)

    def _tokenize(self, text: str) -> tuple[int, ...]:
        return tuple(self.tokenizer.encode(text, add_special_tokens=False))

    def _opened(self, literal: str) -> str:
        """``literal``, which opens an assistant turn, ending in the generation prompt the turn was sampled after."""
        if literal.endswith(self._header) or self._special is None:
            return literal
        if literal.rstrip().endswith(self._header):
            return literal.rstrip()
        for length in range(len(self._header), 0, -1):
            anchor = self._header[:length]
            # Only special tokens are sure to be the template's own: content cannot contain them.
            if not self._special.search(anchor):
                break
            at = literal.rfind(anchor)
            if at >= 0:
                return literal[:at] + self._header
        return literal

    def _accepts_system(self) -> bool:
        try:
            self._apply([{"role": "system", "content": "s"}, {"role": "user", "content": "u"}], generate=True)
        except LLMError:
            return False
        return True

    def _splits_exactly(self) -> bool:
        """Whether tokenising between special tokens equals tokenising the whole text (not so for some
        SentencePieces)."""
        turns = [("user", "Hi there.\n\n  12 é"), ("assistant", " ok"), ("user", "\nx")]
        text = self._apply([{"role": role, "content": content} for role, content in turns], generate=True)
        return self._split is not None and self._encode_literal(text) == self._tokenize(text)

    def _generation_header(self) -> str:
        chat = [{"role": "user", "content": "u"}]
        plain, prompt = self._apply(chat, generate=False), self._apply(chat, generate=True)
        return prompt[len(plain) :] if prompt.startswith(plain) else ""

    def _find_end_of_turn(self, eos: int | None) -> int | None:
        turns = [("user", "u"), ("assistant", f"{_OPEN}0{_CLOSE}"), ("user", "v")]
        text = self._apply([{"role": role, "content": content} for role, content in turns], generate=False)
        pieces = _PLACEHOLDER.split(text)
        ids = self._encode_literal(pieces[-1]) if len(pieces) > 1 else ()
        special = {i for i, t in getattr(self.tokenizer, "added_tokens_decoder", {}).items() if t.special}
        return ids[0] if ids and ids[0] in special else eos


_KWARGS = "agentspec_template_kwargs"


def set_template_kwargs(tokenizer: Any, template_kwargs: Mapping[str, Any]) -> None:
    """Give ``tokenizer`` variables of its chat template, for every prompt that is rendered with it from now on.

    The backends of a trainer render with the trainer's tokenizer, so what is set here (``{"enable_thinking": False}``)
    reaches sampling on every backend, demonstrations and the training forward alike.
    """
    setattr(tokenizer, _KWARGS, dict(template_kwargs))
    _FORMATS.pop(tokenizer, None)


_FORMATS: weakref.WeakKeyDictionary[Any, ChatFormat] = weakref.WeakKeyDictionary()


def chat_format(tokenizer: Any) -> ChatFormat:
    """The :class:`ChatFormat` of ``tokenizer`` with default template variables; made once per tokenizer."""
    found = _FORMATS.get(tokenizer)
    if found is None:
        # The format must not keep its own key alive.
        found = _FORMATS[tokenizer] = ChatFormat(weakref.proxy(tokenizer))
    return found


def render(messages: Sequence[Message], tokenizer: Any) -> list[int]:
    """Token ids of the prompt that ``messages`` make for ``tokenizer`` (see :meth:`ChatFormat.render`)."""
    return chat_format(tokenizer).render(messages)


def _alternatives(tokens: list[str]) -> re.Pattern[str] | None:
    """A pattern of all ``tokens``, longest first, that keeps what it splits at; ``None`` if there are none."""
    if not tokens:
        return None
    return re.compile("(" + "|".join(re.escape(t) for t in sorted(tokens, key=len, reverse=True)) + ")")


def _name(tokenizer: Any) -> str:
    return str(getattr(tokenizer, "name_or_path", "") or tokenizer.__class__.__name__)
