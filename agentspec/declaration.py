"""What a module says about itself: what it costs, what it asks the model for, what it needs.

The declaration stands on the class (`declaration = Declaration(...)`), so that a method is one file. Cost and
capability are known from it before a run; the table in the documentation, `agentspec list`, the trainer's check of
patterns and the contract tests read it. The contract tests hold it against what is really called.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Occasion = Literal["retrieve", "store", "step", "episode"]
Span = tuple[int, int]


@dataclass(frozen=True)
class CallProfile:
    """Model calls as (fewest, most) per occasion under the parameters of a preset.

    A call is one request, whatever the number of samples it asks for; a request to repair an answer is one more.
    `retrieve` is memory's retrieval or the reflector's lessons, `store` what follows a step, `step` one decision
    (reasoning) or one revision (reflection), `episode` what happens at an episode's end.
    """

    retrieve: Span = (0, 0)
    store: Span = (0, 0)
    step: Span = (0, 0)
    episode: Span = (0, 0)

    @property
    def calls_model(self) -> bool:
        """Whether a model may be called at all."""
        return any(most > 0 for _, most in (self.retrieve, self.store, self.step, self.episode))


@dataclass(frozen=True)
class Purpose:
    """What a call is for.

    Args:
        occasion: when it is made.
        example: a well-formed answer, `""` if any text is one. The contract tests answer with it, and a scripted expert
            with its form: texts of several words are replaced by what the expert notes, single words and numbers stay
            (`agentspec.reworded`); so let single words be good ones in any world.
        literal: the example is as good an answer in any world, word for word (a query).
        refers: field that names something the prompt shows (by number or id), about which an expert knows nothing: of a
            list it answers with, items that have one are left out.
    """

    occasion: Occasion
    example: str = ""
    literal: bool = False
    refers: str = ""

    @classmethod
    def each(cls, occasion: Occasion, *names: str) -> dict[str, Purpose]:
        """Purposes of one occasion that any text answers."""
        return {name: cls(occasion) for name in names}


@dataclass(frozen=True)
class Declaration:
    """A module's own description.

    Args:
        summary: one line for `agentspec list`.
        calls: the call profile under default parameters (preset `paper` where there are presets).
        rl: the call profile of preset `rl`; `None` for a method without presets.
        purposes: what its calls are for: the part of a call's path after `/`, which `train` patterns match.
        needs: backend capabilities (`score`, `n`, ...), `snapshots` of the environment, or an `embedder`.
        waived: need -> (parameter, value): with that value the method does without the need.
        scripted: whether it plays what the author of the environment scripted, where there is such a player.
        small: for the contract tests, sets of parameters under which, together, everything the method does fires
            within a dozen steps.
        small_calls: the call profile under each of `small`; `None`: as `calls`.
        scope: `run` for a method that is of no use within one episode: a spec with another scope is refused.
        extra: the extra of this distribution that installs the library it is built on; empty: it needs none.
        untrainable: why no policy can be trained inside it; empty: one can.
        name: name in a spec; empty: the name of the file in this package, outside it the class's name in snake case.
        aliases: other names.
    """

    summary: str = ""
    calls: CallProfile = CallProfile()
    rl: CallProfile | None = None
    purposes: Mapping[str, Purpose] = field(default_factory=dict)
    needs: tuple[str, ...] = ()
    waived: Mapping[str, tuple[str, Any]] = field(default_factory=dict)
    scripted: bool = False
    small: tuple[Mapping[str, Any], ...] = ()
    small_calls: CallProfile | None = None
    scope: str = ""
    extra: str = ""
    untrainable: str = ""
    name: str = ""
    aliases: tuple[str, ...] = ()

    @property
    def presets(self) -> dict[str, CallProfile]:
        """Call profile by preset; empty for a method without presets."""
        return {} if self.rl is None else {"paper": self.calls, "rl": self.rl}

    def needs_with(self, params: Mapping[str, Any]) -> tuple[str, ...]:
        """What the method needs when it is built with `params`."""
        waived = {need for need, (name, value) in self.waived.items() if params.get(name) == value}
        return tuple(need for need in self.needs if need not in waived)
