"""Memories that are somebody else's library: `langmem`, `mem0ai` (version 1) and `graphiti-core`, behind our protocol.

They are here to be compared with: the native methods (`langmem`, `mem0`, `zep`) do the same within the agent and can be
trained. A library is told of the steps in batches, keeps what it makes of them in its own store in this process, and is
searched with the observation. Its prompts are its own. Everything it asks a model goes through the episode's recorder,
so it is metered, budgeted and in the trajectory as `memory.<name>/<purpose>`; its vectors are of the spec's embedder;
nothing goes over the network, and its telemetry is off.

What they cannot do: be trained through. Their prompts hold random ids or the time of day, so an episode cannot be
played again, and what they decide between two calls is out of sight. A training configuration that names one is refused
with the reason. Their state is exported as texts and read again, which is enough for `scope: run`.

Each needs an extra (`pip install 'agentspec-rl[mem0]'`); without it a spec that names it is refused.
"""

from agentspec.memory.libraries.graphiti import GraphitiLibrary
from agentspec.memory.libraries.langmem import LangMemLibrary
from agentspec.memory.libraries.mem0 import Mem0Library

__all__ = ["GraphitiLibrary", "LangMemLibrary", "Mem0Library"]
