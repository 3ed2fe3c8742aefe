"""Methods of other packages: the documented template, built and installed for real, and packages that are at fault."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from small_job import SMALL, call

from ddprt.errors import UserError
from ddprt.methods import METHODS, make_method, packages
from ddprt.methods.floors import MeanMap
from ddprt.methods.listing import table
from ddprt.methods.method import Method
from ddprt.progress import Doubt
from ddprt.runtime.model_file import load_model

DOCS = (Path(__file__).parent.parent / "docs" / "methods.md").read_text("utf-8")


def block(language: str) -> str:
    found = re.findall(rf"```{language}\n(.*?)```", DOCS, re.S)
    assert len(found) == 1
    return found[0]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The template of docs/methods.md, installed into a folder of its own."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("installed")
    (source / "pyproject.toml").write_text(block("toml"))
    (source / "kernel_relighting.py").write_text(block("python"))
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
    done = subprocess.run([*pip, "--target", str(target), str(source)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return target


def as_installed(folder: Path, package: str, points: dict[str, str]) -> Path:
    """What pip writes beside a package, so that its entry points are found."""
    about = folder / f"{package.replace('-', '_')}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[ddprt.methods]\n" + "".join(f"{name} = {at}\n" for name, at in points.items()))
    return folder


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package as installed, whose entry points are all at fault."""
    points = {"broken": "faulty_broken:Broken", "mlp": "faulty_clash:Mlp"}
    folder = as_installed(tmp_path_factory.mktemp("faulty"), "faulty-methods", points)
    (folder / "faulty_broken.py").write_text('raise RuntimeError("no\\nluck")\n')
    (folder / "faulty_clash.py").write_text("raise AssertionError('a taken name is not even imported')\n")
    return folder


def ddprt(*words: object, paths: tuple[Path, ...]) -> subprocess.CompletedProcess[str]:
    places = [*map(str, paths), *filter(None, [os.environ.get("PYTHONPATH")]), str(Path(__file__).parent.parent)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(places)}
    return subprocess.run([sys.executable, "-m", "ddprt", *map(str, words)], capture_output=True, text=True, env=environment)


def test_the_template_is_short() -> None:
    assert len(block("python").splitlines()) <= 60


def test_methods_of_packages_are_listed_and_faulty_ones_named(installed: Path, faulty: Path) -> None:
    done = ddprt("bench", "--methods", paths=(installed, faulty))
    assert done.returncode == 0, done.stderr
    row, settings = re.search(r"^(kernel .*)\n(.*)$", done.stdout, re.M).groups()  # type: ignore[union-attr]
    assert row.split(maxsplit=5) == [
        "kernel",
        "kernel-relighting",
        "no",
        "no",
        "no",
        "how far do neighbours go, without a basis?",
    ]
    assert settings.strip() == "widths = [0.02, 0.05, 0.1, 0.2, 0.5]"
    broken = 'method "broken" of package faulty-methods: got RuntimeError on import (no luck); mend or remove the package'
    clash = 'method "mlp" of package faulty-methods: the name belongs to ddprt; rename its entry point'
    for fault in (broken, clash):
        assert f"left out: {fault}\n" in done.stdout + "\n"
        assert f"warning: {fault}; it is left out\n" in done.stderr
    assert "Traceback" not in done.stderr
    assert re.search(r"^mlp +ddprt +yes +yes +no ", done.stdout, re.M)


def test_a_method_of_a_package_is_fitted_and_scored(installed: Path, faulty: Path, tmp_path: Path) -> None:
    job, run = tmp_path / "job.toml", tmp_path / "run"
    job.write_text(SMALL)
    assert call("bake", job, "--out", run, "--quiet") == 0
    done = ddprt("fit", job, "--out", run, "--fit.method", "kernel", "--methods.compare", "[]", paths=(installed,))
    assert done.returncode == 0, done.stderr
    assert "fit kernel" in done.stderr
    assert '"method": "kernel"' in (run / "model.ddprt" / "model.json").read_text()
    refused = ddprt("fit", job, "--out", run, "--fit.method", "broken", paths=(faulty,))
    assert refused.returncode == 2
    assert refused.stderr.splitlines()[-1].startswith('ddprt: method "broken" of package faulty-methods: got RuntimeError')


@pytest.mark.slow
def test_a_method_of_a_package_is_swept(installed: Path, tmp_path: Path) -> None:
    job = tmp_path / "job.toml"
    job.write_text(SMALL)
    done = ddprt("bench", job, "--out", tmp_path / "run", "--sweep.fit.method", '["kernel"]', paths=(installed,))
    assert done.returncode == 0, done.stderr
    assert "fit.method = kernel" in (tmp_path / "run" / "bench" / "results.jsonl").read_text()


def test_all_that_is_here_is_listed() -> None:
    rows = table().splitlines()
    for name, method in METHODS.items():
        (at,) = (number for number, row in enumerate(rows) if row.startswith(f"{name} "))
        assert rows[at].endswith(method.why)
        assert all(f"{setting} = " in rows[at + 1] for setting in method.model_fields)
    assert re.search(r"^sh-prt +ddprt +no +no +yes ", table(), re.M)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--methods", "job.toml"], "got --methods and job.toml, expected --methods alone"),
        (["--methods", "--fit.bases", "3"], "got --methods and --fit.bases, expected --methods alone"),
        (["--methods", "--peers"], "got --peers and --methods, expected one of them"),
    ],
)
def test_the_list_takes_nothing_else(words: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("bench", *words) == 2
    assert expected in capsys.readouterr().err


@pytest.fixture
def clean(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test registers is gone after it."""
    for name, copy in (("ORIGINS", {}), ("REFUSED", {}), ("_postponed", [])):
        monkeypatch.setattr(packages, name, copy)
    yield
    METHODS.pop("late", None)


class NoWhy(Method):
    relighter = object


class NoFit(Method):
    relighter = object
    why = "none"


class Late(NoFit):
    def fit(self, train: object, validation: object, *, key: object) -> object:  # type: ignore[override]
        raise NotImplementedError


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("other", "DOCS", "expected a class made from ddprt.methods.method.Method"),
        ("other", "NoWhy", "got a class without why and fit"),
        ("other", "NoFit", "got a class without fit"),
        ("other", "Nowhere", "got AttributeError on import"),
        ("../other", "Late", 'got the name "../other", expected letters, digits and hyphens'),
    ],
)
@pytest.mark.usefixtures("clean")
def test_what_is_no_method_is_refused(name: str, value: str, expected: str) -> None:
    methods: dict[str, type[Method]] = {}
    with pytest.warns(Doubt, match=re.escape(expected)):
        packages._take(methods, [EntryPoint(name, f"{__name__}:{value}", packages.GROUP)])
    assert methods == {}
    with pytest.raises(UserError, match=re.escape(expected)):
        make_method(name, {}, {})


@pytest.mark.usefixtures("clean")
def test_of_two_packages_the_first_has_the_name(monkeypatch: pytest.MonkeyPatch) -> None:
    methods: dict[str, type[Method]] = {}
    point = EntryPoint("late", f"{__name__}:Late", packages.GROUP)
    with pytest.warns(Doubt, match=f"the name belongs to {__name__}; rename"):
        packages._take(methods, [point, point])
    assert methods == {"late": Late}


@pytest.mark.usefixtures("clean")
def test_whoever_is_imported_before_ddprt_is_there_when_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its module imports ddprt, which finds the entry point of a module that has no class yet."""
    spec = sys.modules[__name__].__spec__
    monkeypatch.setattr(spec, "_initializing", True, raising=False)
    packages._take(METHODS, [EntryPoint("late", f"{__name__}:Late", packages.GROUP)])
    assert "late" not in METHODS
    monkeypatch.setattr(spec, "_initializing", False)
    assert isinstance(make_method("late", {}, {}), Late)
    assert METHODS["late"] is Late


SICK = """
import sys
import jax.numpy as jnp
from ddprt.methods.floors import MeanLightmap, MeanMap
from ddprt.methods.method import Method

class Mean(Method):
    relighter = MeanMap
    why = "none"

    def fit(self, train, validation, *, key):
        return MeanLightmap().fit(train, validation, key=key)

class Raises(Mean):
    def fit(self, train, validation, *, key):
        raise ZeroDivisionError("oh\\nno")

class Leaves(Mean):
    def fit(self, train, validation, *, key):
        sys.exit(3)

class Nothing(Mean):
    def fit(self, train, validation, *, key):
        return None

class Shape(Mean):
    def fit(self, train, validation, *, key):
        fitted = super().fit(train, validation, key=key)
        return type(fitted)(fitted.mean[:-1], fitted.report)

class Nan(Mean):
    def fit(self, train, validation, *, key):
        fitted = super().fit(train, validation, key=key)
        return type(fitted)(fitted.mean * jnp.nan, fitted.report)
"""
FAULTS = {
    "raises": r"got ZeroDivisionError: oh no;",
    "leaves": r"got SystemExit: 3;",
    "nothing": r"got \w+Error: .*;",
    "shape": r"got \w+Error: .*;",
    "not-a-number": r"got FloatingPointError: answers of NaN for 2 of 2 validation lightings;",
}


@pytest.fixture(scope="module")
def sick(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package whose methods can be imported and not used."""
    classes = {**{name: name.capitalize() for name in FAULTS}, "not-a-number": "Nan"}
    points = {name: f"sick_methods:{kind}" for name, kind in classes.items()}
    folder = as_installed(tmp_path_factory.mktemp("sick"), "sick-methods", points)
    (folder / "sick_methods.py").write_text(SICK)
    return folder


@pytest.fixture
def sickly(sick: Path, clean: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Its methods, registered within this process."""
    monkeypatch.syspath_prepend(str(sick))
    before = set(METHODS)
    packages.register(METHODS)
    yield
    for name in set(METHODS) - before:
        METHODS.pop(name)
    sys.modules.pop("sick_methods", None)


@pytest.mark.usefixtures("sickly")
def test_faults_of_a_package_s_method_are_its_own_and_leave_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line that names method and package, and exit 2; what else was asked for is there."""
    job, run = tmp_path / "job.toml", tmp_path / "run"
    job.write_text(SMALL)
    assert call("bake", job, "--out", run, "--quiet") == 0
    for name, fault in FAULTS.items():
        assert call("fit", job, "--out", run, "--fit.method", name, "--methods.compare", "[]") == 2
        last = capsys.readouterr().err.splitlines()[-1]
        assert re.fullmatch(rf'ddprt: method "{name}" of package sick-methods: {fault} mend or leave it out', last), last
    assert call("fit", job, "--out", run, "--methods.compare", '["raises"]') == 2
    model = load_model(run / "model.ddprt")
    sick = replace(model, method="raises", relighter=MeanMap(jnp.full((int(model.covered.sum()), 3), jnp.nan)))
    with pytest.raises(
        UserError, match='method "raises" of package sick-methods: got FloatingPointError: answers that are not'
    ):
        sick.predict(np.ones((model.points, 3)))
    words = ["--leagues.methods", '["raises", "not-a-number"]', "--leagues.trials", "1", "--leagues.seeds", "1"]
    assert call("bench", job, "--out", run, "--leagues", *words) == 0
    told = (run / "bench" / "leagues.md").read_text()
    for name in ("raises", "not-a-number"):
        assert re.search(rf'\| {name} \|.*method "{name}" of package sick-methods: {FAULTS[name][:-1]}', told)


@pytest.mark.usefixtures("sickly")
def test_a_fault_of_ours_is_not_blamed_on_packages() -> None:
    with pytest.raises(ZeroDivisionError), packages.blamed("svd-ridge"):
        raise ZeroDivisionError
    with pytest.raises(UserError, match=r"^ours$"), packages.blamed("raises"):
        raise UserError("ours")
    cut = r'method "raises" of package sick-methods: got ValueError: x{300}\.\.\.; '
    with pytest.raises(UserError, match=cut), packages.blamed("raises"):
        raise ValueError("x" * 1000)
