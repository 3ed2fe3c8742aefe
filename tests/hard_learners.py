"""Methods other than the linear baseline: trained or looked up, the laws of every method hold."""

from hard_arrays import changed, relit, room
from hard_cases import HardCase
from hard_flaws import all_dark, barely_seen, duplicate, every_size, high_dynamic_range, red, some_dark

FEW = {"settings": {"steps": 40, "width": 8, "check_every": 20}, "method": "mlp"}
DARK = frozenset({"no_signal"})
TRAINED = frozenset({"ok", "worse_than_mean"})
"""After forty steps a network may or may not be better than the mean lightmap; cases ask for its laws."""
KEPT = "finite, black for black, twice the light exactly twice the result, and the same after saving"


CASES: tuple[HardCase, ...] = (
    *(
        HardCase(f"network: {name}", why, KEPT, relit(make, **FEW), DARK if name == "all dark" else TRAINED, slow)
        for name, why, make, slow in (
            ("duplicate points", "inputs repeat", changed(duplicate), True),
            ("rank 1", "one output", lambda: room(1), True),
            ("one lighting", "a spread of one number", lambda: room(train=1), True),
            ("all dark", "nothing to train", changed(all_dark), False),
            ("pure red light", "zero inputs, zero gradients", changed(red), True),
            ("lightings 1e-30 to 1e30", "importances underflow", changed(every_size), True),
            ("twelve decades in one map", "targets of all sizes", changed(high_dynamic_range), True),
            ("hardly seen", "targets of 1e12", changed(barely_seen), True),
        )
    ),
    *(
        HardCase(f"{method}: {name}", why, KEPT, relit(make, method=method), DARK if name == "all dark" else frozenset({"ok"}))
        for method in ("mean", "nearest")
        for name, why, make in (
            ("dark lightings", "a norm of 0 divides", changed(some_dark)),
            ("all dark", "nothing to learn from", changed(all_dark)),
            ("lightings 1e-30 to 1e30", "weights overflow", changed(every_size)),
        )
    ),
)
