"""Do hard cases stay numerically stable?

Question: does every case of the catalogue end finite, within its bound and under a status that fits; do random problems keep
          the laws of relighting; does trust rank lightings as their errors do?
Command:  python experiments/stability.py            everything: minutes
          python experiments/stability.py --quick    the fast cases, and random problems, as far as 42 s allow
Answer:   docs/stability.md

Cases and laws are those of the tests (tests/hard_cases.py, tests/test_random_problems.py); as there, a RuntimeWarning is an
error. Trust and the random problems have a process of their own. The last line is JSON. Exit code 1 if anything fails.
"""

import time

START = time.monotonic()

import json  # noqa: E402
import math  # noqa: E402
import sys  # noqa: E402
import warnings  # noqa: E402
from collections.abc import Callable  # noqa: E402
from concurrent.futures import ProcessPoolExecutor  # noqa: E402
from multiprocessing import get_context  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hard_cases import CASES, HardCase, Outcome, passed  # noqa: E402
from test_random_problems import LAWS, search  # noqa: E402
from trust import quick  # noqa: E402

ENOUGH = 0.8  # rank correlation of trust and error that is asked for
LAST = 42.0  # seconds after which --quick begins nothing more
LONG = {  # cases that --quick leaves out as well: seconds each, most of them to compile what no other case uses
    "bright furnace by paths",
    "dark lightings",
    "gamma 2.2 with noise",
    "intensity 0",
    "lamp that no point sees",
    "lights of 1e3 and 1e-3 together",
    "mean and mono",
    "mean: dark lightings",
    "one lighting",
    "one lighting lit",
    "primary lights",
    "pure red lamps",
    "twelve decades in one map, gamma",
}
SHARES = (60, 20, 6, 2, 1)  # one in so many of a law's problems; every share begins with the problems of the one before


def main(quickly: bool) -> bool:
    """Runs and prints all; whether something failed."""
    warnings.simplefilter("error", RuntimeWarning)
    end = START + LAST if quickly else math.inf
    with ProcessPoolExecutor(1, get_context("spawn")) as beside:
        rest = beside.submit(trust_and_problems, end)
        outcomes = run_cases([case for case in CASES if not (quickly and (case.slow or case.name in LONG))], end)
        trust, tried, broken = rest.result()
    print("\n| law | random problems | |\n| --- | --- | --- |")
    for name, count in tried.items():
        print(f"| {name} | {count} | {'BROKEN: ' + broken[name] if name in broken else 'kept' if count else 'not tried'} |")
    print(f"\nrank correlation of trust and true error: {trust:.3f}, expected at least {ENOUGH}")
    failing = [case.name for case, outcome in outcomes if not passed(case, outcome)]
    worst = max(outcome.error_over_bound for _, outcome in outcomes)
    summary = {
        "cases": len(outcomes),
        "passed": len(outcomes) - len(failing),
        "worst_error_over_bound": worst if math.isfinite(worst) else None,
        "random_problems": sum(tried.values()),
        "spearman_trust": trust,
    }
    failing += [*broken, *(["trust"] if not trust >= ENOUGH else [])]
    whole = sum(most for *_, most in LAWS.values())
    print(f"{len(outcomes)} of {len(CASES)} cases and {sum(tried.values())} of {whole} random problems were run")
    print(f"failing: {', '.join(failing) or 'none'}")
    print(json.dumps(summary | {"failing": failing, "seconds": round(time.monotonic() - START, 1)}))
    return bool(failing)


def run_cases(cases: list[HardCase], end: float) -> list[tuple[HardCase, Outcome]]:
    """Outcomes of as many cases as begin in time, as a table; whatever a case raises fails it."""
    print("| case | status | error over bound | |\n| --- | --- | --- | --- |")
    outcomes = []
    for case in cases:
        if time.monotonic() > end:
            break
        try:
            outcome = case.run()
        except Exception as error:
            outcome = Outcome(math.inf, f"{type(error).__name__}: {error}".partition("\n")[0], finite=False)
        outcomes.append((case, outcome))
        verdict = "right" if passed(case, outcome) else f"WRONG, expected: {case.right}"
        print(f"| {case.name} | {outcome.status} | {outcome.error_over_bound:.2g} | {verdict} |", flush=True)
    return outcomes


def trust_and_problems(end: float) -> tuple[float, dict[str, int], dict[str, str]]:
    """Rank correlation of trust; how many random problems of each law were tried in time; what broke which law."""
    warnings.simplefilter("error", RuntimeWarning)
    trust = quick()["spearman_trust"]
    tried, broken = dict.fromkeys(LAWS, 0), {}
    for share in SHARES if end < math.inf else SHARES[-1:]:
        for name, (law, problems, most) in list(LAWS.items()):
            done = 0

            def in_time(problem: Any, law: Callable[[Any], None] = law) -> None:
                nonlocal done
                if time.monotonic() < end:
                    law(problem)
                    done += 1

            LAWS[name] = in_time, problems, most
            try:
                if name not in broken and time.monotonic() < end:
                    search(name, most // share)
            except Exception as error:
                broken[name] = f"{type(error).__name__}: {error}".partition("\n")[0]
            LAWS[name] = law, problems, most
            tried[name] = max(tried[name], done)
    return trust, tried, broken


if __name__ == "__main__":
    sys.exit(main("--quick" in sys.argv[1:]))
