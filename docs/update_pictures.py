"""Render the pictures of the household worlds: `python docs/update_pictures.py` writes images/{alfred,robothor}.png.

Everything is of the package's own scenes. ALFRED: four moments of the expert's play. RoboTHOR: the apartment from above
with the oracle's way, and what it sees at the start, on the way and where it stops.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from agentspec.envs.alfred.env import AlfredEnv
from agentspec.envs.alfred.expert import Expert
from agentspec.envs.robothor.env import RoboThorEnv
from agentspec.envs.robothor.expert import Oracle
from agentspec.envs.thor.engine import OfflineThor
from agentspec.envs.thor.render import tint
from agentspec.envs.thor.scene import GRID

IMAGES = Path(__file__).parent / "images"
GAP = 6
SCALE = 50
"""Pixels per metre of the map."""


def beside(pictures: list[Image.Image]) -> Image.Image:
    """Pictures of one height in a row."""
    width = sum(p.width for p in pictures) + GAP * (len(pictures) - 1)
    row, x = Image.new("RGB", (width, pictures[0].height), "white"), 0
    for picture in pictures:
        row.paste(picture, (x, 0))
        x += picture.width + GAP
    return row


def play(env: AlfredEnv | RoboThorEnv, player: Expert | Oracle, seed: int) -> list[tuple[str, np.ndarray]]:
    """What is done, and what is seen after it, from the start on."""
    seen, info = env.reset(seed=seed)
    shots, ended = [("", seen["image"])], False
    while not ended:
        text = player.act(info)
        seen, _, terminated, truncated, info = env.step(text)
        shots.append((text, seen["image"]))
        ended = terminated or truncated
    return shots


def alfred() -> Image.Image:
    """A fridge that is open, an apple in slices, pillows on a sofa, a desk with its lamp."""
    moments = ((3, 'OPEN("fridge'), (8, "SLICE"), (1, "PUT"), (15, "PUT"))
    pictures = []
    for seed, text in moments:
        shots = play(AlfredEnv(images=True), Expert({}), seed)
        pictures.append([image for said, image in shots if said.startswith(text)][-1])
    return beside([Image.fromarray(p) for p in pictures])


def above(world: OfflineThor, way: list[tuple[float, float]]) -> Image.Image:
    """The scene from above (north is up): cells as dots, boxes in their colours, walls, the way in red."""
    west, south, east, north = world.scene.area

    def at(x: float, z: float) -> tuple[float, float]:
        return (x - west) * SCALE, (north - z) * SCALE

    image = Image.new("RGB", (round((east - west) * SCALE), round((north - south) * SCALE)), (240, 238, 232))
    canvas = ImageDraw.Draw(image)
    for x, z in ((i * GRID, j * GRID) for i, j in world.scene.cells):
        px, py = at(x, z)
        canvas.ellipse((px - 1.5, py - 1.5, px + 1.5, py + 1.5), fill=(190, 186, 178))
    for body in sorted(world.state.bodies.values(), key=lambda b: b.high[1]):
        canvas.rectangle((*at(body.low[0], body.high[2]), *at(body.high[0], body.low[2])), fill=tint(body.type))
    for (x, _, z), (w, _, d) in world.scene.walls:
        canvas.rectangle((*at(x - w / 2, z + d / 2), *at(x + w / 2, z - d / 2)), fill=(70, 70, 70))
    canvas.line([at(*p) for p in way], fill=(220, 30, 30), width=3)
    (x, y), (u, v) = at(*way[0]), at(*way[-1])
    canvas.ellipse((x - 5, y - 5, x + 5, y + 5), fill=(220, 30, 30))
    canvas.rectangle((u - 5, v - 5, u + 5, v + 5), fill=(220, 30, 30))
    return image


def robothor() -> Image.Image:
    """The map, and three views of the oracle's walk."""
    env, way = RoboThorEnv(images=True), []
    act = env.act

    def noted(action):
        event = act(action)
        p = event.metadata["agent"]["position"]
        way.append((p["x"], p["z"]))
        return event

    env.reset(seed=6)
    agent = env.world.boxes().state.agent
    way.append((agent.x, agent.z))
    env.act = noted  # type: ignore[method-assign]
    shots = play(env, Oracle({}), 6)
    map_ = above(env.world.boxes(), way)
    map_ = map_.resize((round(map_.width * 300 / map_.height), 300))
    views = [shots[0][1], shots[len(shots) // 2][1], shots[-1][1]]
    return beside([map_, *map(Image.fromarray, views)])


if __name__ == "__main__":
    alfred().save(IMAGES / "alfred.png", optimize=True)
    robothor().save(IMAGES / "robothor.png", optimize=True)
