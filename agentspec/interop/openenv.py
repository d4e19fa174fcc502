"""A world as an OpenEnv server, for any OpenEnv client.

    python -m agentspec.interop.openenv minigrid --option suite=memory --port 8000

    with GenericEnvClient(base_url="http://127.0.0.1:8000") as env:
        result = env.reset(split="test", index=0)
        result = env.step({"text": "go forward"})

Needs `pip install 'agentspec-rl[openenv]'`. Every session plays an environment of its own. Splits are ranges of seeds
(`agentspec.tasks`): `reset` takes a `seed`, or a `split` and an `index`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import Any

from openenv.core import Action, Environment, Observation, State, create_app
from openenv.core.env_server.types import EnvironmentMetadata
from pydantic import Field

from agentspec.interop.game import Game
from agentspec.tasks import SPLITS

PREVIEW = 100
"""Most tasks that `list_tasks` lists; every seed of a split is one."""


class TextAction(Action):
    """What the agent does, in the environment's own language."""

    text: str = Field(description="an action call, or one of the observation's choices word for word")


class TextObservation(Observation):
    """What the agent sees."""

    text: str = Field(description="the current observation")
    instruction: str = Field(default="", description="the static part of the prompt; given by reset only")
    choices: list[str] = Field(default_factory=list, description="the texts to choose from, if the world has a menu")
    error: str = Field(default="", description="why the last text could not be carried out, and what to write instead")


class WorldState(State):
    """Where an episode stands."""

    env: str = ""
    seed: int = 0
    total_reward: float = 0.0
    metrics: dict[str, float] = Field(default_factory=dict)


class World(Environment[TextAction, TextObservation, WorldState]):
    """One environment behind OpenEnv's interface.

    Args:
        env: a registered name or id.
        options: of the environment.
    """

    SUPPORTS_CONCURRENT_SESSIONS = True

    def __init__(self, env: str, options: Mapping[str, Any] | None = None) -> None:
        super().__init__()
        self._name = env
        self._game = Game(env, options)
        self._seed = 0
        self._episode: str | None = None

    def reset(
        self,
        seed: int | None = None,
        episode_id: str | None = None,
        split: str = "train",
        index: int = 0,
        **kwargs: Any,
    ) -> TextObservation:
        """A new episode: of `seed`, else of the task `index` of `split`."""
        self._seed = self._seed_of(split, index) if seed is None else seed
        self._episode = episode_id
        text = self._game.start(self._seed)
        return self._observed(text, instruction=self._game.instruction)

    def step(self, action: TextAction, timeout_s: float | None = None, **kwargs: Any) -> TextObservation:
        """One step; a text that is no action is one too, and is answered in `error`."""
        if not self._game.info:
            self.reset()
        return self._observed(self._game.act(action.text), reward=self._game.reward)

    @property
    def state(self) -> WorldState:
        """Steps, rewards and metrics so far."""
        played = bool(self._game.info)
        return WorldState(
            episode_id=self._episode,
            step_count=self._game.steps,
            env=self._name,
            seed=self._seed,
            total_reward=self._game.total,
            metrics=self._game.metrics if played else {},
        )

    def get_metadata(self) -> EnvironmentMetadata:
        """Name and what it is."""
        return EnvironmentMetadata(name=self._name, description=f"{self._name}, in words, by AgentSpec")

    def close(self) -> None:
        """Let go of the environment."""
        self._game.close()

    def _observed(self, text: str, *, reward: float | None = None, instruction: str = "") -> TextObservation:
        game = self._game
        return TextObservation(
            text=text,
            instruction=instruction,
            choices=list(game.schema.choices),
            error=str(game.info["error"]),
            reward=reward,
            done=game.over,
            metadata={"metrics": game.metrics},
        )

    # -- tasks: every seed of a split is one

    def list_splits(self) -> list[str]:
        """Names of the splits."""
        return list(SPLITS)

    def num_tasks(self, split: str) -> int:
        """Number of seeds in a split; the last one has no end of its own and gets as many as the others."""
        _check_split(split)
        return SPLITS["validation"]

    def get_task(self, split: str, index: int) -> dict[str, Any]:
        """The task at `index`."""
        return {"id": f"{self._name}-{split}-{index}", "index": index, "seed": self._seed_of(split, index)}

    def get_task_range(self, split: str, start: int | None = None, stop: int | None = None) -> list[dict[str, Any]]:
        """Tasks by slice."""
        return [self.get_task(split, i) for i in range(self.num_tasks(split))[start:stop]]

    def list_tasks(self, split: str) -> list[dict[str, Any]]:
        """The first tasks of a split."""
        return self.get_task_range(split, 0, PREVIEW)

    def _seed_of(self, split: str, index: int) -> int:
        if not 0 <= index < self.num_tasks(split):
            raise IndexError(f"{split} has tasks 0 to {self.num_tasks(split) - 1}; got {index}")
        return SPLITS[split] + index


def _check_split(split: str) -> None:
    if split not in SPLITS:
        raise ValueError(f"unknown split {split!r}; expected one of {', '.join(SPLITS)}")


def factory(env: str, options: Mapping[str, Any] | None = None) -> Callable[[], World]:
    """What makes one environment per session."""
    return lambda: World(env, options)


def app(env: str, options: Mapping[str, Any] | None = None, *, sessions: int = 16) -> Any:
    """The FastAPI application that serves `env` to at most `sessions` clients at once.

    Raises:
        SpecError: an unknown environment, or options it does not take.
    """
    World(env, options).close()
    return create_app(
        factory(env, options),
        TextAction,
        TextObservation,
        env_name=env,
        max_concurrent_envs=sessions,
        state_cls=WorldState,
    )


def main() -> None:
    """Serve a world."""
    import uvicorn

    from agentspec.cli.arguments import key_values
    from agentspec.cli.errors import expected_errors

    parser = argparse.ArgumentParser(description="Serve an environment to OpenEnv clients.", allow_abbrev=False)
    parser.add_argument("env", help="a registered name or id, such as minigrid")
    parser.add_argument("--option", action="append", default=[], metavar="KEY=VALUE", help="of the environment; YAML")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--sessions", type=int, default=16, help="most clients at once")
    given = parser.parse_args()
    with expected_errors():
        served = app(given.env, key_values(given.option, "--option"), sessions=given.sessions)
        uvicorn.run(served, host=given.host, port=given.port)


if __name__ == "__main__":
    main()
