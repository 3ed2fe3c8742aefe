"""The only door to Embree: triangles that it knows, and rays handed to it in packets.

embreex, which brings the library, hands rays over one by one. Here its C interface is used directly, from compiled loops. On
the same machine both give the same bits, but for shadow rays that pass the rim of a surface within rounding: a packet may let
them by. Packets are as wide as the processor takes at once, but of eight rays at most: sixteen are slower but for a single lamp
in an almost empty room (docs/baking.md).
"""

import ctypes
import os
import weakref
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ddprt.axes import Float32, Int32
from ddprt.compiled import call_at, compiled
from ddprt.errors import UserError

FAR = 1e37
"""Distance of what a ray never meets, metres."""

_ADDRESS, _NUMBER, _SIZE = ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t
_FUNCTIONS: dict[str, tuple[object, ...]] = {
    "rtcNewDevice": (_ADDRESS, _ADDRESS),
    "rtcGetDeviceProperty": (ctypes.c_ssize_t, _ADDRESS, _NUMBER),
    "rtcGetDeviceError": (_NUMBER, _ADDRESS),
    "rtcGetDeviceLastErrorMessage": (ctypes.c_char_p, _ADDRESS),
    "rtcNewScene": (_ADDRESS, _ADDRESS),
    "rtcSetSceneFlags": (None, _ADDRESS, _NUMBER),
    "rtcNewGeometry": (_ADDRESS, _ADDRESS, _NUMBER),
    "rtcSetNewGeometryBuffer": (_ADDRESS, _ADDRESS, _NUMBER, ctypes.c_uint, _NUMBER, _SIZE, _SIZE),
    "rtcCommitGeometry": (None, _ADDRESS),
    "rtcAttachGeometry": (ctypes.c_uint, _ADDRESS, _ADDRESS),
    "rtcReleaseGeometry": (None, _ADDRESS),
    "rtcCommitScene": (None, _ADDRESS),
    "rtcReleaseScene": (None, _ADDRESS),
}
"""What each function returns and takes."""

# Numbers of Embree 4's headers.
_VERSION, _NATIVE_RAY8 = 0, 33  # RTCDeviceProperty
_TRIANGLES = 0  # RTCGeometryType
_ROBUST = 4  # RTCSceneFlags: no ray slips through an edge that two triangles share
_INDEX, _VERTEX = 0, 1  # RTCBufferType
_THREE_NUMBERS, _THREE_FLOATS = 0x5003, 0x9003  # RTCFormat

# Rows of RTCRayHit4 and RTCRayHit8, a column to a ray; the mask of valid rays follows as a row of its own.
_ORIGIN, _DIRECTION, _END, _MASK, _U, _V, _TRIANGLE, _MESH, _VALID = 0, 4, 8, 9, 15, 16, 17, 18, 21
_LINE = 16  # floats of a cache line, at which a packet must begin


@dataclass(frozen=True)
class Embree:
    """The library, loaded.

    Attributes:
      calls: its functions.
      device: what all scenes are made on; it lives as long as the process.
      version: as it tells it.
      width: rays of a packet.
      intersect, occluded: where the functions are that trace one.
    """

    calls: ctypes.CDLL
    device: int
    version: str
    width: int
    intersect: int
    occluded: int


@lru_cache
def embree(settings: bytes | None = None) -> Embree:
    """Loads it, once.

    Args:
      settings: of Embree's own, such as b"isa=avx2", for tests.
    Raises:
      UserError: embreex or something in its library is missing (there is no slow fallback), or it does not start.
    """
    try:
        from embreex import rtcore_scene
    except ImportError as error:
        raise UserError(f"embreex: got {error}, expected the ray tracer; pip install embreex") from None
    try:
        # What an extension is linked with is found through it, but on Windows, where it bears its own name.
        calls = ctypes.CDLL("embree4.dll" if os.name == "nt" else rtcore_scene.__file__)
        for name, (answer, *given) in _FUNCTIONS.items():
            function = getattr(calls, name)
            function.restype, function.argtypes = answer, given
        device = calls.rtcNewDevice(settings)
        _check(calls, device, "a device")
        width = 8 if calls.rtcGetDeviceProperty(device, _NATIVE_RAY8) else 4
        trace = [ctypes.cast(getattr(calls, f"{name}{width}"), _ADDRESS).value or 0 for name in ("rtcIntersect", "rtcOccluded")]
    except (OSError, AttributeError) as error:
        raise UserError(f"embreex: got {error}, expected Embree 4.4; pip install embreex==4.4.0.post1") from None
    number = calls.rtcGetDeviceProperty(device, _VERSION)
    version = f"{number // 10000}.{number // 100 % 100}.{number % 100}"
    return Embree(calls, device, version, width, *trace)


def _check(calls: ctypes.CDLL, device: int | None, wanted: str) -> None:
    """Raises what Embree has noted since it was last asked in this thread."""
    if code := calls.rtcGetDeviceError(device):
        reason = (calls.rtcGetDeviceLastErrorMessage(device) or b"no reason").decode(errors="replace")
        raise UserError(f"Embree: got error {code} ({reason}), expected {wanted}; take a smaller scene if memory is short")


class Geometry:
    """Triangles that Embree knows. Many threads may trace them.

    Args:
      corners: metres.
    Raises:
      UserError: Embree is missing, or cannot take them.
    """

    def __init__(self, corners: Float32[np.ndarray, "triangles 3 3"]) -> None:
        self._embree = embree()
        calls, device = self._embree.calls, self._embree.device
        self._scene = calls.rtcNewScene(device)
        weakref.finalize(self, calls.rtcReleaseScene, self._scene).atexit = False  # then the system takes all memory back
        calls.rtcSetSceneFlags(self._scene, _ROBUST)
        mesh = calls.rtcNewGeometry(device, _TRIANGLES)
        try:
            self._fill(mesh, _VERTEX, _THREE_FLOATS, np.ascontiguousarray(corners.reshape(-1, 3)))
            self._fill(mesh, _INDEX, _THREE_NUMBERS, np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3))
            calls.rtcCommitGeometry(mesh)
            calls.rtcAttachGeometry(self._scene, mesh)
        finally:
            calls.rtcReleaseGeometry(mesh)
        calls.rtcCommitScene(self._scene)
        _check(calls, device, f"a tree of {len(corners)} triangles")

    def _fill(self, mesh: int, kind: int, form: int, rows: np.ndarray) -> None:
        """Copies rows of three into a new buffer of Embree's."""
        calls = self._embree.calls
        buffer = calls.rtcSetNewGeometryBuffer(mesh, kind, 0, form, rows.strides[0], len(rows))
        _check(calls, self._embree.device, f"a buffer of {len(rows)} rows")
        ctypes.memmove(buffer, rows.ctypes.data, rows.nbytes)

    def first(
        self,
        origins: Float32[np.ndarray, "rays 3"],
        directions: Float32[np.ndarray, "rays 3"],
        reach: Float32[np.ndarray, " rays"] | None = None,
    ) -> tuple[np.ndarray, ...]:
        """See `Tracer.first`; nothing further than `reach` metres counts, which is overwritten with the distances."""
        triangle = np.empty(len(origins), np.int32)
        u, v = np.empty((2, len(origins)), np.float32)
        distance = np.full(len(origins), FAR, np.float32) if reach is None else reach
        using = self._embree.intersect, self._embree.width, self._scene
        _intersect(*using, origins, directions, distance, triangle, u, v)
        return triangle, u, v, distance

    def unoccluded(
        self,
        origins: Float32[np.ndarray, "rays 3"],
        directions: Float32[np.ndarray, "rays 3"],
        reach: Float32[np.ndarray, " rays"],
    ) -> Int32[np.ndarray, " rays"]:
        """See `Tracer.unoccluded`."""
        seen = np.empty(len(origins), np.int32)
        _occlude(self._embree.occluded, self._embree.width, self._scene, origins, directions, reach, seen)
        return seen


@compiled
def _packet(width: int) -> np.ndarray:
    """Rows of a packet, at the beginning of a cache line: no motion, from distance 0, all valid."""
    memory = np.zeros((_VALID + 1) * width + _LINE, np.float32)
    start = (-memory.ctypes.data // 4) % _LINE
    packet = memory[start : start + (_VALID + 1) * width].reshape(_VALID + 1, width)
    packet[_MASK].view(np.int32)[:] = -1
    packet[_VALID].view(np.int32)[:] = -1
    return packet


@compiled
def _load(packet: np.ndarray, first: int, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> int:
    """Writes the rays from `first` on into a packet; returns how many they are, and makes the rest of it invalid."""
    width = packet.shape[1]
    count = min(width, len(origins) - first)
    for k in range(count):
        for axis in range(3):
            packet[_ORIGIN + axis, k] = origins[first + k, axis]
            packet[_DIRECTION + axis, k] = directions[first + k, axis]
        packet[_END, k] = reach[first + k]
    if count < width:
        packet[_VALID].view(np.int32)[count:] = 0
    return count


@compiled
def _intersect(
    function: int,
    width: int,
    scene: int,
    origins: np.ndarray,
    directions: np.ndarray,
    reach: np.ndarray,
    triangle: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
) -> None:
    packet = _packet(width)
    words, found = (packet[_VALID].ctypes.data, scene, packet.ctypes.data, 0), packet.view(np.int32)
    for first in range(0, len(origins), width):
        count = _load(packet, first, origins, directions, reach)
        for k in range(width):  # Embree leaves what it was given where a ray escapes
            found[_TRIANGLE, k] = found[_MESH, k] = -1
            packet[_U, k] = packet[_V, k] = 0
        call_at(function, words)
        for k in range(count):
            triangle[first + k], reach[first + k] = found[_TRIANGLE, k], packet[_END, k]
            u[first + k], v[first + k] = packet[_U, k], packet[_V, k]


@compiled
def _occlude(
    function: int,
    width: int,
    scene: int,
    origins: np.ndarray,
    directions: np.ndarray,
    reach: np.ndarray,
    seen: np.ndarray,
) -> None:
    packet = _packet(width)
    words = packet[_VALID].ctypes.data, scene, packet.ctypes.data, 0
    for first in range(0, len(origins), width):
        count = _load(packet, first, origins, directions, reach)
        call_at(function, words)
        for k in range(count):
            seen[first + k] = not packet[_END, k] < 0  # minus infinity where a ray is stopped
