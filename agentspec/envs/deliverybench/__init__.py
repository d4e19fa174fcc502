"""DeliveryBench: a courier earns money in a city, simulated headless and exactly.

Four rooms, each importing only those before it: `city` (map files, streets, routes, generated cities), `world` (state,
rules and time of a shift, the actions), `view` (what an agent sees: data, texts, menu, picture) and `expert` (scripted
couriers: baseline and demonstrator). `env` puts them behind Gymnasium's interface; `replay` compares the world with
recorded episodes of the original.
"""

from agentspec.envs.registration import register_env

STEP_LIMIT = 5000
"""Steps after which every episode is cut: some actions take no time."""

register_env(
    "agentspec/DeliveryBench-v0",
    "agentspec.envs.deliverybench.env:DeliveryBenchEnv",
    name="deliverybench",
    summary="a courier earns money in a city: orders, deadlines, battery, energy, hot and cold food",
    max_episode_steps=STEP_LIMIT,
)
# The same world with numbers for actions and observations, for other libraries.
register_env(
    "agentspec/DeliveryBenchDiscrete-v0",
    "agentspec.envs.deliverybench.discrete:make",
    max_episode_steps=STEP_LIMIT,
)
