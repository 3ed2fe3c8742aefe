"""An effect that nobody needs, for tests of the catalogue: one file and one entry, as all are. Bright walls sparkle."""

from dataclasses import replace
from pathlib import Path

import ddprt.transport
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.transport.effects import EFFECTS, Effect, Entry, Question

NAME, MODULE = "sparkle", "ddprt.transport.sparkle"
FILE = '''"""Sparkle."""

from ddprt.compiled import compiled


@compiled
def twice(number):
    return 2 * number
'''


def sparkles(material: Material) -> bool:
    return max(material.albedo) >= 0.95


def decide(name: str, question: Question) -> Effect:
    users = question.users(sparkles)
    return Effect(name, bool(users), users or "no material sparkles")


def without(scene: Scene) -> Scene:
    """Duller walls, so that leaving it out can be seen in the light."""
    return scene.made_of(lambda material: replace(material, albedo=(0.5,) * 3) if sparkles(material) else material)


ENTRY = Entry(decide, "sparkle", without, lambda question: 40.0)


def register(folder: Path) -> None:
    """Writes the file and enters the effect; what is changed is `ddprt.transport.__path__` and `EFFECTS`."""
    (folder / "sparkle.py").write_text(FILE)
    ddprt.transport.__path__.append(str(folder))
    EFFECTS[NAME] = ENTRY
