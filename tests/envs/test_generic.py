"""The adapter: Gymnasium's numbers as text, its discrete actions as a menu."""

from __future__ import annotations

import enum
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from agentspec.envs import check_environment, make_env
from agentspec.envs.generic import TextAdapter, adapted, keeps_contract
from agentspec.envs.generic.describe import describe, is_picture, plain
from agentspec.registry import SpecError
from agentspec.types import Task


class Space(gymnasium.Env[Any, Any]):
    """An environment of given spaces that repeats what it was told: the reward is 1, it never ends."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, action_space: Any, observation_space: Any = None, told: Any = None) -> None:
        self.action_space = action_space
        self.observation_space = observation_space or spaces.Box(-1, 1, (2,))
        self.told = told or {}
        self.acted: list[Any] = []
        self.render_mode = None

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), self.told

    def step(self, action: Any) -> Any:
        self.acted.append(action)
        return self.observation_space.sample(), 1.0, False, False, self.told


def started(env: Any) -> TextAdapter:
    adapter = TextAdapter(env, "Space-v0")
    adapter.reset(seed=0)
    return adapter


def test_a_menu_of_discrete_actions() -> None:
    env = make_env(Task("CartPole-v1"))
    observation, info = env.reset(seed=0)
    assert info["action_schema"].choices == ("push left", "push right")
    assert observation["text"].startswith("cart position 0.0137, cart velocity -0.02302, pole angle (rad) ")
    assert observation["text"].endswith("\nActions: push left; push right")
    inner = gymnasium.make("CartPole-v1")
    inner.reset(seed=0)
    expected = inner.step(1)
    for text in ("push right", "PUSH_RIGHT()", "Push  Right"):
        env.reset(seed=0)
        _, reward, _, _, info = env.step(text)
        assert info["state"]["observation"] == expected[0].tolist() and reward == 1.0 and not info["invalid"]


def test_a_text_that_is_no_action_does_not_reach_the_environment() -> None:
    inner = Space(spaces.Discrete(2))
    env = started(inner)
    _, reward, _, _, info = env.step("jump")
    assert (reward, inner.acted, info["invalid"], info["error_code"]) == (0.0, [], True, "PARSE_NOT_CALL")
    assert "action 0; action 1" in info["error"]
    env.limit = 3
    assert [env.step("jump")[3] for _ in range(2)] == [False, True]  # refused texts use up the limit of steps
    env.step("action 0")
    assert inner.acted == []  # after the end nothing happens


def test_the_menu_follows_the_mask_of_the_environment() -> None:
    env = started(Space(spaces.Discrete(3, start=5), told={"action_mask": np.array([0, 1, 1], np.int8)}))
    observation, info = env.reset(seed=0)
    assert info["action_schema"].choices == ("action 1", "action 2") and "action 0" not in observation["text"]
    env.step("action 2")
    assert env.inner.acted == [7]  # the space starts at 5
    info = env.step("ACTION_0()")[4]  # a call names what the menu leaves out
    assert env.inner.acted == [7] and info["error"].endswith("is not possible now; possible are action 1; action 2")


def test_a_mask_holds_for_large_spaces_too() -> None:
    env = started(Space(spaces.Discrete(50), told={"action_mask": np.eye(50, dtype=np.int8)[3]}))
    assert "ACT(4) is not possible now; possible are ACT(3)" in env.step("ACT(4)")[4]["error"]
    assert not env.step("ACT(3)")[4]["invalid"] and env.inner.acted == [3]


@pytest.mark.parametrize(
    ("space", "text", "value"),
    [
        (spaces.Discrete(100), "ACT(17)", 17),
        (spaces.MultiDiscrete([3, 4]), "ACT([2, 3])", [2, 3]),
        (spaces.MultiBinary(3), "ACT([1, 0, 1])", [1, 0, 1]),
        (spaces.Text(10), 'ACT("look")', "look"),
    ],
)
def test_large_and_composite_spaces_are_called(space: Any, text: str, value: Any) -> None:
    inner = Space(space)
    env = started(inner)
    assert not env.step(text)[4]["invalid"]
    assert np.array_equal(inner.acted[0], value) and space.contains(inner.acted[0])
    several = ("ACT(1, 2)",) if not isinstance(space, spaces.MultiDiscrete) else ()  # two numbers are its list
    for wrong in ("ACT()", "ACT([9, 9, 9, 9])", "ACT(1000)", *several):
        told = env.step(wrong)[4]
        assert told["invalid"] and "write ACT(" in told["error"]
    assert len(inner.acted) == 1
    check_environment(TextAdapter(Space(space), "Space-v0"))


def test_a_number_is_not_rounded_to_an_action() -> None:
    env = started(Space(spaces.Discrete(100)))
    assert "2.7 is none of Discrete(100)" in env.step("ACT(2.7)")[4]["error"] and env.inner.acted == []
    env = started(Space(spaces.MultiDiscrete([3, 4])))
    assert env.step("ACT([1.5, 2])")[4]["invalid"] and env.inner.acted == []


def test_an_environment_that_cannot_be_made_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SpecError, match="render_mode must be a text or null, got 5"):
        make_env(Task("CartPole-v1", options={"render_mode": 5}))

    def missing(name: str) -> Any:
        raise gymnasium.error.DependencyNotInstalled("Box2D is not installed")

    monkeypatch.setattr("agentspec.envs.making.importlib.import_module", missing)
    with pytest.raises(SpecError, match=r"LunarLander-v3 needs a package that is not installed: "):
        make_env(Task("LunarLander-v3"))


def test_continuous_actions_are_refused() -> None:
    with pytest.raises(SpecError, match="expected a discrete or text action space"):
        make_env(Task("Pendulum-v1"))


def test_environments_name_their_own_actions() -> None:
    class Moves(enum.IntEnum):
        turn_left = 0
        go = 1

    inner: Any = Space(spaces.Discrete(2))
    inner.actions = Moves
    assert started(inner).names.actions == ("turn left", "go")
    inner.get_action_meanings = lambda: ["NOOP", "FIRE"]
    assert started(inner).names.actions == ("noop", "fire")
    inner.get_action_meanings = lambda: ["FIRE", "FIRE"]  # would name two actions alike
    del inner.actions
    assert started(inner).names.actions == ("action 0", "action 1")


def test_a_grid_of_codes_has_one_symbol_a_cell_and_a_legend() -> None:
    grid = np.zeros((3, 4, 3), np.uint8)
    grid[0, 1] = (2, 5, 0)
    grid[2, 3] = (1, 0, 0)
    text = describe(spaces.Box(0, 255, grid.shape, np.uint8), grid)
    # The commonest cell is a dot; the others are lettered by their values: 1 0 0 comes before 2 5 0.
    assert text == ".b..\n....\n...a\n(. = 0 0 0, a = 1 0 0, b = 2 5 0)"


def test_every_kind_of_space_has_a_text_and_plain_data() -> None:
    space = spaces.Dict(
        {
            "at": spaces.Tuple((spaces.Discrete(9), spaces.Box(-1, 1, (2,), np.float64))),
            "says": spaces.Text(20),
            "view": spaces.Box(0, 255, (64, 48, 3), np.uint8),
            "heat": spaces.Box(-1, 1, (40, 40), np.float32),
        }
    )
    value = {
        "at": (3, np.array([0.25, -1 / 3])),
        "says": "hello",
        "view": np.zeros((64, 48, 3), np.uint8),
        "heat": np.linspace(-1, 1, 1600, dtype=np.float32).reshape(40, 40),
    }
    lines = describe(space, value).splitlines()
    assert lines == [
        "at: 3, 0.25, -0.3333",
        "heat: [40 x 40 numbers from -1 to 1]",
        "says: hello",
        "view: [a picture of 48 x 64 pixels]",
    ]  # a Dict space sorts its keys
    data = plain(space, value)
    assert data["at"] == [3, [0.25, -1 / 3]] and data["view"] is None and data["heat"][0][0] == -1.0


def test_pictures_become_images() -> None:
    picture = spaces.Box(0, 255, (64, 48, 3), np.uint8)
    assert is_picture(picture) and not is_picture(spaces.Box(0, 255, (7, 7, 3), np.uint8))
    for space in (picture, spaces.Dict({"view": picture, "at": spaces.Discrete(3)})):
        env = TextAdapter(Space(spaces.Discrete(2), space), "Space-v0")
        observation, _ = env.reset(seed=1)
        assert observation["image"].shape == (64, 48, 3) and env.observation_space.contains(observation)
    assert "image" not in started(Space(spaces.Discrete(2))).observation_space.spaces


def test_what_an_environment_draws_can_be_its_image() -> None:
    pytest.importorskip("minigrid")
    env = make_env(Task("MiniGrid-Empty-5x5-v0", options={"render_mode": "rgb_array"}))
    observation, _ = env.reset(seed=0)
    assert observation["image"].dtype == np.uint8 and observation["image"].ndim == 3
    assert "mission: get to the green goal square" in observation["text"] and observation["text"].count("\n") < 14


def test_success_is_passed_on_where_the_environment_knows_it() -> None:
    for told in ({"is_success": np.True_}, {"success": 1}):
        info = started(Space(spaces.Discrete(2), told=told)).step("action 0")[4]
        assert info["success"] is True and info["metrics"] == {"success": True}
    check_environment(TextAdapter(Space(spaces.Discrete(2), told={"is_success": 0}), "Space-v0"))


def test_a_text_environment_is_left_alone() -> None:
    env = make_env(Task("deliverybench", options={"size": "tiny"}))
    assert keeps_contract(env) and adapted(env, "x") is env
