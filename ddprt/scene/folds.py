"""Does a chart lie on itself? Triangles are compared with those that share a square of a grid, so that time stays linear."""

import numpy as np

from ddprt.axes import Bool, Float64, Int
from ddprt.compiled import compiled

_ENTRIES, _PAIRS, _PAIRS_EACH = 16, 20_000_000, 256  # bounds on the work of a chart; beyond it, a chart counts as folded


def folded(
    flat: Float64[np.ndarray, "triangles 3 2"], chart: Int[np.ndarray, " triangles"], tolerance: float
) -> Bool[np.ndarray, " charts"]:
    """Which charts lie on themselves somewhere (or are too intricate to be sure).

    Args:
      flat: corners of each triangle.
      chart: of each triangle.
      tolerance: depth of overlap that counts as touching, share of a chart's size.
    """
    count = int(chart.max()) + 1
    order, start = grouped(chart, count)
    bad = np.zeros(count, np.bool_)
    _folds(np.ascontiguousarray(flat[order]).reshape(-1, 6), start, tolerance, bad)
    return bad


def grouped(group: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Members in the order of their groups, and where each group starts, with the end."""
    order = np.argsort(group, kind="stable")
    return order, np.searchsorted(group[order], np.arange(count + 1))


@compiled
def _folds(flat: np.ndarray, start: np.ndarray, tolerance: float, bad: np.ndarray) -> None:
    """Sorts each chart's triangles into squares and compares those that share one."""
    for chart in range(len(start) - 1):
        n = start[chart + 1] - start[chart]
        if n < 2:
            continue
        mine = _turned(flat[start[chart] : start[chart + 1]])
        left, low, right, high, wide, tall = mine[0, 0], mine[0, 1], mine[0, 0], mine[0, 1], 0.0, 0.0
        for f in range(n):
            left, right = min(left, _least(mine[f], 0)), max(right, _most(mine[f], 0))
            low, high = min(low, _least(mine[f], 1)), max(high, _most(mine[f], 1))
            wide, tall = wide + _most(mine[f], 0) - _least(mine[f], 0), tall + _most(mine[f], 1) - _least(mine[f], 1)
        size = max(right - left, high - low, 1e-300)
        side, rise = max(wide, 1e-9 * size) / n, max(tall, 1e-9 * size) / n
        while (int((right - left) / side) + 1) * (int((high - low) / rise) + 1) > 4 * n + 4:
            side, rise = 1.5 * side, 1.5 * rise
        while True:
            across, down = int((right - left) / side) + 1, int((high - low) / rise) + 1
            end = np.zeros(across * down, np.int64)
            entries = 0
            for f in range(n):
                for row in range(_square(_least(mine[f], 1), low, rise, down), _square(_most(mine[f], 1), low, rise, down) + 1):
                    first, last = _columns(mine[f], low + row * rise, low + (row + 1) * rise)
                    for column in range(_square(first, left, side, across), _square(last, left, side, across) + 1):
                        end[row * across + column] += 1
                        entries += 1
                if entries > _ENTRIES * n and across * down > 1:
                    break
            if entries <= _ENTRIES * n or across * down == 1:
                break
            side, rise = 2 * side, 2 * rise
        end = np.cumsum(end)
        place, member = end.copy(), np.empty(entries, np.int64)
        for f in range(n):
            for row in range(_square(_least(mine[f], 1), low, rise, down), _square(_most(mine[f], 1), low, rise, down) + 1):
                first, last = _columns(mine[f], low + row * rise, low + (row + 1) * rise)
                for column in range(_square(first, left, side, across), _square(last, left, side, across) + 1):
                    place[row * across + column] -= 1
                    member[place[row * across + column]] = f
        budget, begin = _PAIRS + _PAIRS_EACH * n, 0
        for cell in range(across * down):
            budget -= (end[cell] - begin) ** 2 // 2
            if budget < 0 or bad[chart]:
                bad[chart] = True
                break
            for i in range(begin, end[cell]):
                for j in range(begin, i):
                    if _overlap(mine[member[i]], mine[member[j]], tolerance * size):
                        bad[chart] = True
                        break
                if bad[chart]:
                    break
            begin = end[cell]


@compiled
def _turned(flat: np.ndarray) -> np.ndarray:
    """With most sides along an axis, so that squares fit slivers."""
    twice_x, twice_y = 0.0, 0.0
    for f in range(len(flat)):
        for k in range(0, 6, 2):
            dx, dy = flat[f, (k + 2) % 6] - flat[f, k], flat[f, (k + 3) % 6] - flat[f, k + 1]
            twice_x, twice_y = twice_x + dx * dx - dy * dy, twice_y + 2 * dx * dy
    angle = 0.5 * np.arctan2(twice_y, twice_x)
    cosine, sine = np.cos(angle), np.sin(angle)
    turned = np.empty_like(flat)
    for f in range(len(flat)):
        for k in range(0, 6, 2):
            x, y = flat[f, k], flat[f, k + 1]
            turned[f, k], turned[f, k + 1] = cosine * x + sine * y, cosine * y - sine * x
    return turned


@compiled
def _square(at: float, origin: float, side: float, count: int) -> int:
    return min(max(int((at - origin) / side), 0), count - 1)


@compiled
def _least(t: np.ndarray, axis: int) -> float:
    return min(t[axis], t[axis + 2], t[axis + 4])


@compiled
def _most(t: np.ndarray, axis: int) -> float:
    return max(t[axis], t[axis + 2], t[axis + 4])


@compiled
def _columns(t: np.ndarray, low: float, high: float) -> tuple[float, float]:
    """Least and greatest x of the part of a triangle between two heights."""
    least, most = np.inf, -np.inf
    for k in range(3):
        x0, y0, x1, y1 = t[2 * k], t[2 * k + 1], t[(2 * k + 2) % 6], t[(2 * k + 3) % 6]
        if low <= y0 <= high:
            least, most = min(least, x0), max(most, x0)
        for height in (low, high):
            if (y0 < height) != (y1 < height):
                x = x0 + (x1 - x0) * (height - y0) / (y1 - y0)
                least, most = min(least, x), max(most, x)
    return (least, most) if least <= most else (_least(t, 0), _most(t, 0))


@compiled
def _overlap(one: np.ndarray, other: np.ndarray, depth: float) -> bool:
    """Whether two triangles overlap by more than `depth`: no side of either has all of the other beyond it."""
    for axis in range(2):
        if _least(one, axis) > _most(other, axis) - depth or _least(other, axis) > _most(one, axis) - depth:
            return False
    for a, b in ((one, other), (other, one)):
        for k in range(3):
            x, y = a[2 * k], a[2 * k + 1]
            dx, dy = a[(2 * k + 2) % 6] - x, a[(2 * k + 3) % 6] - y
            length = np.sqrt(dx * dx + dy * dy)
            if length <= depth:
                continue
            dx, dy = dx / length, dy / length
            third = dx * (a[(2 * k + 5) % 6] - y) - dy * (a[(2 * k + 4) % 6] - x)
            sign = 1.0 if third > 0 else -1.0
            furthest = -np.inf
            for m in range(0, 6, 2):
                furthest = max(furthest, sign * (dx * (b[m + 1] - y) - dy * (b[m] - x)))
            if furthest < depth:
                return False
    return True
