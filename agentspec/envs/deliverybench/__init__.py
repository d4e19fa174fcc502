"""DeliveryBench: a courier earns money in a city, simulated headless and exactly.

The city (`citymap`, `routing`, `generate`), the world (`world`, `rules`, `orders`, ...), and what an agent sees of them
(`env`, `observation`, `menu`, `render`), with scripted couriers (`courier`) as baseline and demonstrator.
"""

from agentspec.envs.deliverybench.citymap import City, MapError, load_city
from agentspec.envs.deliverybench.generate import generate, split_of, write_city

__all__ = ["City", "MapError", "generate", "load_city", "split_of", "write_city"]
