"""Numbers as a reader wants them: few digits, and the unit that suits them."""


def percent(value: float | int | None) -> str:
    """A share in percent; a dash for none."""
    if value is None:
        return "–"
    whole = abs(100 * value)
    return f"{100 * value:.{0 if whole >= 99.5 else 1 if whole >= 9.95 else 2}f}\u00a0%"


def seconds(value: float | int) -> str:
    """A time in s, ms, µs or ns."""
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if value >= 0.9995 * scale:
            return f"{value / scale:.3g} {unit}"
    return "0 s" if value == 0 else f"{value * 1e9:.0f} ns"


def size(value: float | int) -> str:
    """Bytes in binary units."""
    for unit, scale in (("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if value >= scale:
            return f"{value / scale:.1f} {unit}"
    return f"{value:.0f} B"


def count(value: float | int) -> str:
    """A count in G, M or k."""
    for unit, scale in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if value >= scale:
            return f"{value / scale:.3g} {unit}"
    return f"{value:.0f}"
