"""DeliveryBench: a courier earns money in a city, simulated headless and exactly.

The city (`citymap`, `routing`, `generate`), the world (`world`, `rules`, `orders`, ...), and what an agent sees of them
(`env`, `observation`, `menu`, `render`), with scripted couriers (`courier`) as baseline and demonstrator.
"""
