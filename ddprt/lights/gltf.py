"""Lights of a glTF file (KHR_lights_punctual), where its nodes put them.

Their units are candela and lux, and exporters make them of watts by 683 lm/W, the most light that a watt can be. That is
undone: candela become W/sr, lux W/m². What an exporter wrote in watts is taken as it stands where units are "radiometric".
A `range` is no property of light and is ignored. Emission of surfaces has no such factor, as exporters give it none.
"""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Float64
from ddprt.errors import UserError
from ddprt.scene.accessors import Container, open_gltf
from ddprt.scene.gltf_nodes import placed

LUMENS_PER_WATT = 683.0
"""Of green light; SI since 1979."""

_NAME = "KHR_lights_punctual"
_HARD = 1 - 1e-4  # inner angle of a cone without a soft rim, as a share of the outer one


def light_records(path: Path, units: str) -> list[dict[str, Any]]:
    """The lights of a file's default scene as JSON-like records, in the order of the hierarchy; see `parse_lighting`.

    Args:
      path: a .glb or .gltf.
      units: of its numbers.
    Raises:
      UserError: no such file, a damaged one, one without lights, or a light of no known type.
    """
    if not path.is_file():
        raise UserError(f"{path}: got no such file, expected glTF with lights; check the path")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pygltflib speaks by warnings
            file = open_gltf(path)
            lamps = (file.json.extensions or {}).get(_NAME, {}).get("lights", [])
            found = [
                _record(file, lamps, node, world, units) for _, node, world in placed(file) if _NAME in (node.extensions or {})
            ]
    except UserError:
        raise
    except Exception as problem:  # what pygltflib says of its insides helps nobody
        raise UserError(
            f"{path.name}: got a damaged file, expected glTF 2.0 with {_NAME}; export it again, or run with --debug to see "
            "where reading stopped"
        ) from problem
    if not found:
        raise UserError(
            f"{path.name}: got no light, expected some of {_NAME} in its scene; export punctual lights with it, or list lights "
            "in a JSON file"
        )
    return found


def _record(file: Container, lamps: list[Any], node: Any, world: Float64[np.ndarray, "4 4"], units: str) -> dict[str, Any]:
    number = node.extensions[_NAME]["light"]
    if not 0 <= number < len(lamps):
        raise file.fault(f"got light {number} at a node, expected one of the {len(lamps)} there are; export it again")
    lamp = lamps[number]
    power = float(lamp.get("intensity", 1.0)) / (LUMENS_PER_WATT if units == "photometric" else 1.0)
    colour = [float(channel) * power for channel in lamp.get("color", [1.0, 1.0, 1.0])]
    position, direction = world[:3, 3].tolist(), (-world[:3, 2]).tolist()
    kind = lamp.get("type")
    if kind == "directional":
        return {"type": kind, "direction": direction, "irradiance": colour}
    if kind == "point":
        return {"type": kind, "position": position, "intensity": colour}
    if kind != "spot":
        raise file.fault(f'got light {number} of type "{kind}", expected directional, point or spot; export it again')
    cone = lamp.get("spot", {})
    outer = float(np.rad2deg(cone.get("outerConeAngle", np.pi / 4)))
    # A rim that is not soft at all is written as two equal angles, which leave no room to fall off in.
    inner = float(np.rad2deg(cone.get("innerConeAngle", 0.0)))
    inner = outer * _HARD if outer * _HARD < inner <= outer * (1 + 1e-6) else inner
    shape = {"inner_deg": inner, "outer_deg": min(outer, 90.0) if outer < 90.001 else outer}
    return {"type": kind, "position": position, "direction": direction, "intensity": colour, **shape}
