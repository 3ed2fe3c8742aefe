"""Deals: the same lightings shared out anew between training and validation; held-out ones stay what they are."""

from dataclasses import replace
from typing import Any

import numpy as np

from ddprt import seeds
from ddprt.dataset.store import Dataset
from ddprt.report.metrics import Tally, Truth
from ddprt.runtime.model import Model

_REDRAWN = 100  # times, where a deal was dealt before


def deal(data: Dataset, seed: int, number: int, train: int = 0) -> Dataset:
    """A dataset whose training and validation lightings have changed places; the files are the same.

    Args:
      data: as baked, which is deal 0.
      seed: of the run.
      number: of the deal.
      train: keep only so many training lightings; 0 keeps all.
    """
    pool, count = [*data.split("train"), *data.split("validation")], len(data.split("train"))
    seen = {frozenset(pool[count:])}
    for each in range(1, number + 1):
        rng, before = seeds.stream(seed, "deal", each), pool
        for _ in range(_REDRAWN):
            pool = [before[place] for place in rng.permutation(len(before))]
            if frozenset(pool[count:]) not in seen:
                break
        seen.add(frozenset(pool[count:]))
        pool = pool if each == number else before
    where = dict.fromkeys(pool[: train or count], "train") | dict.fromkeys(pool[train or count : count], "unused")
    where |= dict.fromkeys(pool[count:], "validation")
    entries = [
        {**entry, "split": where.get(index, entry["split"])} for index, entry in enumerate(data.description["lightings"])
    ]
    return replace(data, description={**data.description, "lightings": entries})


def method_seed(seed: int, number: int) -> int:
    """The key of learned methods in a deal; in deal 0 that of `ddprt fit`."""
    return seeds.number(seed, "deal", number) if number else seed


def tally(model: Model, data: Dataset, split: str) -> Tally:
    """Errors of a model on the lightings of a split, one by one."""
    area, parts = data.area, []
    for index in data.split(split):
        values = data.values([index], model.points, model.quantity)[0]
        predicted = model.predict(values, lightings=data.lightings[index], constant=False)[None]
        parts.append(Truth(data.maps("indirect", [index]), area).tally(predicted))
    return Tally.joined(parts)


def lit_by(data: Dataset, indices: list[int], tracer: Any) -> list[dict[str, Any]]:
    """Of each lighting: kinds of its lights, and metres from its nearest lamp to a surface (None for distant light)."""
    told = []
    for index in indices:
        lighting = data.lightings[index]
        places = [place for light in lighting if (place := light.anchor()) is not None]
        near = float(tracer.clearance(np.array(places)).min()) if places else None
        kinds = sorted({light.kind for light in lighting})
        told.append({"index": index, "kind": " and ".join(kinds), "lights": len(lighting), "distance": near})
    return told
