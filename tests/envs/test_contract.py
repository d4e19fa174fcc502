"""The environment contract: every registered environment keeps it, and the checker sees each way of breaking it."""

from __future__ import annotations

import importlib.util
import pkgutil
import threading
from typing import Any

import gymnasium
import pytest

import agentspec.envs
from agentspec.envs import ContractError, check_environment, make_env
from agentspec.envs.contract import INFO_KEYS
from agentspec.metrics import Metric
from agentspec.registry import REGISTRY
from agentspec.types import Task
from tests.reasoning.numbers_env import NUMBERS, NumbersEnv
from tests.toy_env import TOY, ToyEnv

OPTIONS: dict[str, list[dict[str, Any]]] = {
    "deliverybench": [
        {"size": "tiny", "shift_hours": 0.1},
        {"size": "tiny", "shift_hours": 0.1, "observation": "compact", "action_mode": "menu"},
        {"size": "tiny", "shift_hours": 0.1, "max_steps": 5, "images": True},
    ],
    "alfred": [{"max_steps": 6}, {"max_steps": 6, "action_mode": "menu", "images": True}],
    "robothor": [{"max_steps": 6}, {"max_steps": 6, "preset": "casestudy", "action_mode": "menu", "images": True}],
}
"""Options under which an episode is short; an environment without an entry is checked as it comes."""

CASES = [(name, options) for name in sorted(REGISTRY.entries["env"]) for options in OPTIONS.get(name, [{}])]


@pytest.mark.parametrize(("name", "options"), CASES, ids=str)
def test_registered_environments_keep_the_contract(name: str, options: dict[str, Any]) -> None:
    check_environment(Task(name, options=options))


def test_every_environment_of_ours_has_a_short_name() -> None:
    # a folder with a module env is an environment; thor and generic are what environments are made of
    packages = [m.name for m in pkgutil.iter_modules(agentspec.envs.__path__) if m.ispkg]
    folders = {name for name in packages if importlib.util.find_spec(f"agentspec.envs.{name}.env")}
    assert folders
    ids = [entry.target for entry in REGISTRY.entries["env"].values()]
    homes = [str(gymnasium.spec(i).entry_point).removeprefix("agentspec.envs.").partition(".")[0] for i in ids]
    assert folders <= set(homes)


@pytest.mark.parametrize("name", [TOY, NUMBERS])
@pytest.mark.parametrize("menu", [False, True])
def test_the_test_worlds_keep_it_too(name: str, menu: bool) -> None:
    check_environment(Task(name, options={"menu": menu}))


def test_a_limit_of_steps_really_ends_an_episode() -> None:
    task = Task(TOY, options={"max_episode_steps": 2})
    check_environment(task)
    env = make_env(task)
    env.reset(seed=0)
    reports = [env.step("SELL()") for _ in range(4)]
    assert [r[3] for r in reports] == [False, True, True, True]
    assert [r[1] > 0 for r in reports] == [True, True, False, False]
    assert env.unwrapped.t == 2  # gymnasium's limit alone would let the toy sell on


class Broken(ToyEnv):
    """A toy with one fault of a kind that the checker must name."""

    def __init__(self, fault: str = "", **options: Any) -> None:
        super().__init__(**options)
        self.kind = fault
        self.played = 0
        self.metadata = {
            "no such metric": {"metrics": (*ToyEnv.metadata["metrics"], Metric("tips"))},
            "metric by name": {"metrics": ("net_earnings",)},
            "scale": {"typical_return": 0},
        }.get(fault, ToyEnv.metadata)

    def reset(self, **settings: Any) -> Any:
        self.played += 1
        observation, info = super().reset(**settings)
        if self.kind == "lock":
            self.lock = threading.Lock()
        if self.kind == "history" and self.played > 1:
            self.prices = [p + self.played for p in self.prices]
            observation, info = self._observation(), self._info("", False)
        return observation, info

    def step(self, action: str) -> Any:
        if self.kind == "goes on" and self.t >= self.steps:
            self.balance += 1
            return self._observation(), 1.0, True, False, self._info("", False)
        result = super().step(action)
        if self.kind == "raises" and result[4]["invalid"]:
            raise KeyError(action)
        return result

    def restore(self, blob: bytes) -> None:
        balance = self.balance
        super().restore(blob)
        if self.kind == "half restore":
            self.balance = balance

    def _observation(self) -> dict[str, Any]:
        return {} if self.kind == "no text" else super()._observation()

    def _info(self, error: str, invalid: bool) -> dict[str, Any]:
        info = super()._info(error, invalid)
        if self.kind in info:
            del info[self.kind]
        if self.kind == "silent":
            info["error"] = ""
        if self.kind == "always invalid":
            info["invalid"] = True
        if self.kind == "lenient":
            info |= {"invalid": False, "error": ""}
        if self.kind == "restless instruction":
            info["instruction"] += f" Step {self.t}."
        if self.kind == "object":
            info["state"] = {"nan": float("nan")}
        return info


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("no such metric", "the declared metric 'tips' is not reported"),
        ("metric by name", "expected a tuple of agentspec.metrics.Metric"),
        ("scale", "expected a number above 0"),
        ("no text", "the observation has no text"),
        *((key.name, f"info has no {key.name!r}") for key in INFO_KEYS if key.required),
        ("silent", "expected info['invalid'] and an info['error']"),
        ("always invalid", "set both or neither"),
        ("lenient", "is no action; expected info['invalid']"),
        ("restless instruction", "changes from step to step"),
        ("object", "info is not JSON data"),
        ("history", "played again with the same seed"),
        ("lock", "deepcopy after reset raised TypeError"),
        ("lock", "pickle after reset raised TypeError"),
        ("half restore", "restore(snapshot()) changes the snapshot"),
        ("raises", "refuses: raised KeyError"),
        ("goes on", "a step after the end pays 1.0"),
        ("goes on", "a step after the end changes the metrics"),
    ],
)
def test_the_checker_names_each_fault(fault: str, said: str) -> None:
    with pytest.raises(ContractError) as caught:
        check_environment(Broken(fault))
    assert said in str(caught.value)


def test_a_menu_entry_that_cannot_be_done_is_a_fault() -> None:
    class Boasting(NumbersEnv):
        def step(self, action: str) -> Any:
            observation, reward, terminated, truncated, info = super().step(action)
            if action == "double it":
                info |= {"invalid": True, "error": "doubling is not possible"}
            return observation, reward, terminated, truncated, info

    with pytest.raises(ContractError, match="'double it' cannot be carried out: doubling is not possible"):
        check_environment(Boasting(menu=True))


def test_charged_thinking_is_reported() -> None:
    class Forgetful(NumbersEnv):
        def deliberate(self, calls: int, tokens: int) -> None:
            return None

    with pytest.raises(ContractError, match=r"reports info\['thought'\] \[\]; expected \[2, 10\]"):
        check_environment(Forgetful())


def test_half_a_pair_of_snapshot_methods_is_a_fault() -> None:
    class Half(NumbersEnv):
        restore = None  # type: ignore[assignment]

    with pytest.raises(ContractError, match="snapshot and restore belong together"):
        check_environment(Half())


def test_all_faults_are_told_at_once() -> None:
    with pytest.raises(ContractError) as caught:
        check_environment(Broken("half restore", fault_step=1))
    assert str(caught.value).startswith("Broken does not keep the environment contract:\n- ")


@pytest.mark.parametrize("name", ["CartPole-v1", "FrozenLake-v1", "Taxi-v4", "Blackjack-v1", "MountainCar-v0"])
def test_environments_of_gymnasium_keep_it_behind_the_adapter(name: str) -> None:
    check_environment(name)
