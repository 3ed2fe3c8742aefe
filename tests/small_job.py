"""A job that is baked and fitted in about a second, for tests that try many settings of one, and the words that start it."""

import tomllib
from typing import Any

import pytest

from ddprt.bench.measure.settings import changed
from ddprt.cli import main
from ddprt.config import Config, checked

SMALL = """
[atlas]
resolution = 32
[lightings]
train = 8
validation = 2
test = 4
[points]
count = 12
supersample = 2
[transport]
samples = 8
threads = 2
[fit]
bases = 4
[methods.settings.mlp]
steps = 5
width = 8
[bench]
repeats = 1
path_frames = 0
pictures = 0
noise = 0.3
"""


def base(**changes: Any) -> Config:
    """The job with other values, two underscores for a dot: `base(fit__bases=2)`."""
    return changed(checked(tomllib.loads(SMALL)), {key.replace("__", "."): value for key, value in changes.items()})


def call(*words: object) -> int:
    """What the command line exits with."""
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    return int(stop.value.code or 0)
