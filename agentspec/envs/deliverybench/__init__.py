"""DeliveryBench: a courier earns money in a city, simulated headless and exactly.

Four rooms, each importing only those before it: `city` (map files, streets, routes, generated cities), `world` (state,
rules and time of a shift, the actions), `view` (what an agent sees: data, texts, menu, picture) and `expert` (scripted
couriers: baseline and demonstrator). `env` puts them behind Gymnasium's interface; `replay` compares the world with
recorded episodes of the original.
"""

from agentspec.envs.deliverybench.city.citymap import City, MapError, load_city
from agentspec.envs.deliverybench.city.generate import generate, split_of, write_city

__all__ = ["City", "MapError", "generate", "load_city", "split_of", "write_city"]
