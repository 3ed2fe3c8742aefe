"""What an export says of the fog that its light was learned in."""

from typing import Any

from ddprt.runtime.model import Model

DECODE = (
    "in fog: direct light, E_direct of the samples and that of all surfaces, is what a lamp sends times exp(-length / "
    "mean_free_path) per channel, with the length of its way through the box from low to high, metres; E_indirect knows the fog"
)


def told(model: Model) -> dict[str, Any]:
    """The manifest's entry: mean free paths (metres), albedo, anisotropy, and the corners of the box that it fills (metres)."""
    if model.fog is None:
        return {}
    corners = model.occluders.reshape(-1, 3)
    return {"fog": {**model.fog.record, "low": corners.min(0).tolist(), "high": corners.max(0).tolist()}}


def notes(model: Model) -> list[str]:
    """The same for whoever reads one engine's README alone."""
    if not (fog := told(model).get("fog")):
        return []
    path, low, high = (", ".join(f"{value:.6g}" for value in fog[key]) for key in ("mean_free_path", "low", "high"))
    return [
        f"**Fog.** This model was learned in fog, which fills the box from ({low}) to ({high}) metres. Wherever direct light\n"
        "is shaded, at samples and on surfaces, multiply what a lamp sends by exp(-length / mean free path) per channel: the\n"
        f"length of its way through the box in metres, mean free paths of red, green and blue {path}.\n"
        "The lightmap knows the fog."
    ]
