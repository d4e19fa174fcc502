"""An animation of an episode, from the frames that the environment draws."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import gymnasium

from agentspec.episode import make_env
from agentspec.files import write_atomic
from agentspec.registry import SpecError
from agentspec.types import Task

FRAME_MS = 400


class Film:
    """Collects the frames of one task's episode and writes them as a GIF.

    The task itself stays as it is: drawing changes neither its key nor the episode's seed.

    Args:
        path: where the GIF goes.
        task: whose episode is filmed; all others are left alone.

    Raises:
        SpecError: the environment draws no frames.
    """

    def __init__(self, path: str | Path, task: Task) -> None:
        self.path = Path(path)
        self.task = task
        self.frames: list[Any] = []
        env = make_env(task)
        modes = env.metadata.get("render_modes") or []
        env.close()
        if "rgb_array" not in modes:
            raise SpecError(f"{task.env} draws no frames (render modes: {modes or 'none'}); leave out --gif")

    def make_env(self, task: Task) -> Any:
        """The environment of ``task``, filmed if it is the one."""
        if task != self.task:
            return make_env(task)
        options = {**task.options, "render_mode": "rgb_array"}
        return _Filmed(make_env(Task(task.env, task.seed, options, task.split)), self.frames)

    def save(self) -> None:
        """Write the GIF; the last frame stays for two seconds.

        Raises:
            SpecError: there is no frame.
        """
        if not self.frames:
            raise SpecError(f"no frame was drawn of {self.task.env}, so {self.path} was not written; leave out --gif")
        buffer = io.BytesIO()
        durations = [FRAME_MS] * (len(self.frames) - 1) + [5 * FRAME_MS]
        first, *others = self.frames
        first.save(buffer, format="GIF", save_all=True, append_images=others, duration=durations, loop=0)
        write_atomic(self.path, buffer.getvalue())


class _Filmed(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Keeps a frame of every state, with 256 colours: an hour's shift fits into memory."""

    def __init__(self, env: Any, frames: list[Any]) -> None:
        super().__init__(env)
        self._frames = frames

    def reset(self, **settings: Any) -> Any:
        result = self.env.reset(**settings)
        self._keep()
        return result

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        self._keep()
        return result

    def _keep(self) -> None:
        from PIL import Image

        frame: Any = self.env.render()
        if frame is not None:
            self._frames.append(Image.fromarray(frame).quantize(256))
