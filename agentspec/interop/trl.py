"""A world as tools for TRL: a class for `GRPOTrainer(environment_factory=...)`.

    from agentspec.interop.trl import dataset, environment_factory

    options = {"level": "MiniGrid-Empty-5x5-v0", "observation": "compact"}
    trainer = GRPOTrainer(
        model="Qwen/Qwen3-0.6B",
        train_dataset=dataset("minigrid", options, count=64),
        environment_factory=environment_factory("minigrid", options),
        ...
    )

Every action of the environment becomes a method with typed parameters and a docstring, from which TRL derives the
tool's schema; `get_reward` is what TRL scores a rollout with. Stock TRL trains one growing conversation; scaffolds
(memories, searches, debates) need this package's own trainer.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal

from agentspec.interop.game import Game
from agentspec.literals import render_call
from agentspec.registry import SpecError
from agentspec.tasks import make_tasks
from agentspec.types import ActionSchema, ActionSpec, Parameter

TYPES: Mapping[str, Any] = {"int": int, "float": float, "str": str, "list": list, "any": Any}
TAKEN = ("reset", "get_reward")


class Tools:
    """Base of the classes that `environment_factory` makes: `reset` and `get_reward`; subclasses add the actions."""

    _env: ClassVar[str] = ""
    _options: ClassVar[Mapping[str, Any]] = {}
    _score: ClassVar[str] = "return"

    def __init__(self) -> None:
        self._game = Game(self._env, self._options)

    def reset(self, seed: int = 0, **_: Any) -> str:
        """A new episode of the row's seed; its first observation, which TRL appends to the user turn."""
        return self._game.start(seed)

    def get_reward(self) -> float:
        """What the episode came to."""
        return self._game.score(self._score)


class Menu(Tools):
    """The tool of an environment whose choices change from step to step."""

    def act(self, action: str) -> str:
        """
        Do one of the actions that the last observation lists.

        Args:
            action: the action, word for word.

        Returns:
            what you observe then.
        """
        return self._game.act(action)


def environment_factory(env: str, options: Mapping[str, Any] | None = None, *, score: str = "return") -> type[Tools]:
    """The class of tools of an environment.

    Args:
        env: a registered name or id.
        options: of the environment; with a menu (`action_mode: menu`) whose choices change from step to step there is
            one tool, `act(action)`; prefer native calls.
        score: what `get_reward` gives: the sum of rewards (`return`) or a metric of the environment.

    Raises:
        SpecError: an action whose name TRL needs for itself.
    """
    game = Game(env, options)
    game.start()
    try:
        game.score(score)
    except KeyError as error:
        raise SpecError(str(error.args[0])) from None
    schema = game.schema
    game.close()
    methods = {} if schema.choices else {_method(n): _tool(s, schema) for n, s in schema.actions.items()}
    taken = [name for name in TAKEN if name in methods]
    if taken:
        raise SpecError(f"{env} has an action {taken[0]!r}, which is TRL's name for something else; rename it")
    body = {**methods, "_env": env, "_options": dict(options or {}), "_score": score}
    return type(re.sub(r"\W+", "_", env).title().replace("_", ""), (Menu if schema.choices else Tools,), body)


def dataset(
    env: str, options: Mapping[str, Any] | None = None, *, count: int = 64, split: str = "train"
) -> list[dict[str, Any]]:
    """Rows for `Dataset.from_list`: instruction as system text, an empty user turn for what is observed, the seed."""
    game = Game(env, options)
    rows = []
    for task in make_tasks(env, dict(options or {}), count, split=split):
        game.start(task.seed)
        prompt = [{"role": "system", "content": game.instruction}, {"role": "user", "content": ""}]
        rows.append({"prompt": prompt, "seed": task.seed})
    game.close()
    return rows


def _method(action: str) -> str:
    return re.sub(r"\W+", "_", action).lower()


def _tool(spec: ActionSpec, schema: ActionSchema) -> Callable[..., str]:
    """A method that carries out one action, with the signature and docstring that a schema is derived from."""

    def tool(self: Tools, *args: Any, **kwargs: Any) -> str:
        given = tool.__signature__.bind(self, *args, **kwargs).arguments  # type: ignore[attr-defined]
        values = {name: value for name, value in given.items() if name != "self" and value is not None}
        return self._game.act(render_call(spec.name, (), values, schema))

    kinds = {name: _type(parameter) for name, parameter in spec.parameters.items()}
    inputs = [inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)]
    needed_first = sorted(spec.parameters.items(), key=lambda item: not item[1].required)
    for name, parameter in needed_first:
        default = inspect.Parameter.empty if parameter.required else parameter.default
        inputs.append(
            inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=default, annotation=kinds[name])
        )
    tool.__signature__ = inspect.Signature(inputs, return_annotation=str)  # type: ignore[attr-defined]
    tool.__annotations__ = {**kinds, "return": str}
    tool.__name__ = tool.__qualname__ = _method(spec.name)
    tool.__doc__ = _documented(spec)
    return tool


def _type(parameter: Parameter) -> Any:
    kind = Literal[parameter.enum] if parameter.enum else TYPES[parameter.type]
    return kind if parameter.required or kind is Any else kind | None


def _documented(spec: ActionSpec) -> str:
    """Google style, as the deriving of schemas wants it."""
    what = spec.description or spec.name.lower().replace("_", " ")
    example = f" For example {spec.example}." if spec.example and spec.parameters else ""
    lines = [f"{what[:1].upper()}{what[1:].rstrip('.')}.{example}", ""]
    if spec.parameters:
        lines.append("Args:")
        lines += [f"    {name}: {_about(name, parameter)}" for name, parameter in spec.parameters.items()]
        lines.append("")
    return "\n".join([*lines, "Returns:", "    what you observe then."])


def _about(name: str, parameter: Parameter) -> str:
    words = name.replace("_", " ")
    return words if parameter.required else f"{words}; may be left out"
