"""Pictures in prompts: from an observation's array to a PNG that a backend can send or show.

Pictures are part of the current step's user turn only (`agentspec.context`): what was seen earlier is not sent again.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from typing import Any

import numpy as np

from agentspec.llm.base import LLMError, Message
from agentspec.types import Picture

LARGEST = 1024
"""Default limit of the longer side, in pixels, for backends that scale pictures down before they are sent."""


def picture(array: Any) -> Picture:
    """A picture as a prompt carries it.

    Args:
        array: `uint8`, shape (H, W, 3).

    Raises:
        ValueError: of another type or shape.
    """
    from PIL import Image

    pixels = np.asarray(array)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3 or 0 in pixels.shape:
        raise ValueError(f"a picture of type {pixels.dtype} and shape {pixels.shape}; expected uint8, (H, W, 3)")
    return _encoded(Image.fromarray(pixels))


def opened(shown: Picture) -> Any:
    """The picture as a `PIL.Image` in RGB."""
    from PIL import Image

    return Image.open(io.BytesIO(shown.png)).convert("RGB")


def fitted(shown: Picture, largest: int = LARGEST) -> Picture:
    """The picture scaled down, in proportion, until its longer side has at most `largest` pixels."""
    from PIL import Image

    longer = max(shown.width, shown.height)
    if longer <= largest:
        return shown
    size = tuple(max(1, round(side * largest / longer)) for side in (shown.width, shown.height))
    return _encoded(opened(shown).resize(size, Image.Resampling.LANCZOS))


def data_url(shown: Picture) -> str:
    """`data:image/png;base64,...`"""
    return f"data:image/png;base64,{base64.b64encode(shown.png).decode()}"


def pictures_of(messages: Iterable[Message]) -> list[Picture]:
    """All pictures of a prompt, in order."""
    return [part for message in messages for part in message.content if isinstance(part, Picture)]


def refuse_pictures(messages: Iterable[Message], who: str) -> None:
    """Keep pictures from being dropped by a backend that reads text only.

    Raises:
        LLMError: there are pictures in the prompt.
    """
    found = pictures_of(messages)
    if found:
        raise LLMError(
            f"the prompt holds {len(found)} pictures and {who} reads text only; leave `images` out of the perception, "
            "or use a model that sees (an endpoint, or `backend: vision`)"
        )


def _encoded(image: Any) -> Picture:
    buffer = io.BytesIO()
    image.save(buffer, format="PNG")
    return Picture(buffer.getvalue(), image.width, image.height)
