"""A frame of an exported model: from what is measured, or from lights, to the rows that its shader reads.

It reads the files of an export and nothing else, as an engine would.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file

from ddprt.axes import Float, Float32


@dataclass(frozen=True, eq=False)
class Frames:
    """What of an export runs once a frame.

    Attributes:
      manifest: as read.
      transfer: tensors of the last step.
      network: tensors of what comes before it, none where nothing does.
    """

    manifest: dict[str, Any]
    transfer: dict[str, np.ndarray]
    network: dict[str, np.ndarray]

    @classmethod
    def read(cls, folder: Path) -> "Frames":
        """Those of an export."""
        manifest = json.loads((folder / "manifest.json").read_text())
        name = manifest["deployment"]["network"]
        return cls(manifest, load_file(folder / manifest["matrix"]["file"]), load_file(folder / name) if name else {})

    def rows(self, inputs: Mapping[str, np.ndarray]) -> Float32[np.ndarray, "rows 4"]:
        """A frame.

        Args:
          inputs: `values` (points, 3) in W/m²; or of the lights `harmonics` (numbers, 3), or `strength` (lights, 3) and `told`
            (lights, numbers).
        """
        z, s = self._encoded(inputs["values"]) if "values" in inputs else (None, np.ones(3))
        n, t = self.network, self.transfer
        rows = {}
        if self.manifest["deployment"]["shape"] == "table":
            assert z is not None
            best = self._best(z)
            bend = self.manifest["gamma"] if self.manifest["space"] == "gamma" else 1.0
            s = s * np.array(self.manifest["basis_scale"])[best] ** bend
            rows["best"] = best[:, None]
        else:
            parts = self._parts(inputs, z)
            f = np.concatenate([parts[name] for name in self.manifest["deployment"]["features"]], 1)
            rows["u"] = np.einsum("gbp,gp->gb", t["matrix"], f - t["offset"]) + t["intercept"]
        if "counts" in n:
            rows["counts"] = np.einsum("chp,cp->ch", n["counts"], np.broadcast_to(f, (3, f.shape[1])))
        if "turn" in n:
            v = np.einsum("gkp,gp->gk", n["coefficients"], f)
            first = n["first"] + np.tensordot(v, n["turn"], 1)
        rows["s"] = s[:, None]
        out = np.zeros((sum(count for _, count in self.manifest["deployment"]["frame"].values()), 4), np.float32)
        for name, (start, count) in self.manifest["deployment"]["frame"].items():
            if name == "first":
                out[start : start + count] = first.reshape(-1, 4)
            else:
                out[start : start + count, :3] = rows[name].T
        return out

    def _encoded(self, values: Float[np.ndarray, "points 3"]) -> tuple[np.ndarray, np.ndarray]:
        """z by groups, and s of each colour."""
        mono = self.manifest["channels"] == "mono"
        s = np.linalg.norm(values, axis=0 if mono else None) * np.ones(3)
        z = values / np.where(s > 0, s, 1)
        if self.manifest["space"] == "gamma":
            z = np.sign(z) * np.abs(z) ** (1 / self.manifest["gamma"])
        return z.T if mono else z.reshape(1, -1), s

    def _best(self, z: np.ndarray) -> np.ndarray:
        if "seen" not in self.network:
            return np.zeros(3, int)
        colours = z if len(z) == 3 else z.reshape(-1, 3).T
        likeness = np.einsum("clp,cp->cl", self.network["seen"], colours)
        return np.argmax(np.where(self.network["lit"] > 0, likeness, -np.inf), 1)

    def _parts(self, inputs: Mapping[str, np.ndarray], z: np.ndarray | None) -> dict[str, np.ndarray]:
        """All that features may be made of, by name."""
        n = self.network
        if "harmonics" in inputs:
            return {"harmonics": np.asarray(inputs["harmonics"]).T}
        if "told" in inputs:
            phi = np.asarray(inputs["strength"]).T @ np.cos(inputs["told"] @ n["frequencies"] + n["phases"])
            return {"cosines": phi.reshape(len(self.transfer["matrix"]), -1)}
        assert z is not None
        c = z @ n["reader"].T if "reader" in n else z
        size = np.linalg.norm(c, axis=1, keepdims=True) if "reader" in n else np.ones((len(z), 1))
        h, k = c / np.where(size > 0, size, 1), 0
        while f"weight_{k}" in n:
            h = _gated(h @ n[f"weight_{k}"] + n[f"bias_{k}"])
            k += 1
        return {"z": z, "units": size * h, "size": size}


def _gated(a: np.ndarray) -> np.ndarray:
    return 0.5 * a * (1 + a / (1 + np.abs(a)))
