"""One line for every fault, and what comes out goes in again."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ddprt.config import Config, keys, load_config
from ddprt.errors import UserError

CONFIGS = sorted((Path(__file__).parent.parent / "configs").glob("*.toml"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.stem)
def test_resolved_configuration_is_accepted_again(path: Path, tmp_path: Path) -> None:
    config = load_config(path)
    resolved = tmp_path / "config.toml"
    resolved.write_text(config.to_toml())
    assert load_config(resolved) == config
    assert load_config(resolved).digest() == config.digest()


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.stem)
def test_configurations_explain_themselves(path: Path) -> None:
    assert path.read_text().startswith("#"), "a comment says what the job is"


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1e-30, 0.5, 1e30]), st.text(max_size=20))
def test_any_value_survives_the_round_trip(seed: int, ridge: float, name: str) -> None:
    import tomllib

    config = Config.model_validate({"seed": seed, "fit": {"ridge": ridge}, "scene": {"name": name}})
    assert Config.model_validate(tomllib.loads(config.to_toml())) == config


def test_overrides_win_over_the_file() -> None:
    config = load_config(CONFIGS[0], {"fit.bases": "7", "fit.ridge": "1e-3", "lightings.kinds": '["spot", "point"]'})
    assert (config.fit.bases, config.fit.ridge, config.lightings.kinds) == (7, 1e-3, ("spot", "point"))
    assert load_config(None, {"fit.space": "gamma", "seed": "5"}).seed == 5
    assert load_config(None, {"methods.settings.mlp": "{steps = 3}"}).methods.settings == {"mlp": {"steps": 3}}
    assert load_config(None, {"scene.parameters.albedo": "0.25"}).scene.parameters == {"albedo": 0.25}


def test_paths_count_from_the_file_that_names_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    job, run = tmp_path / "jobs" / "room.toml", tmp_path / "runs" / "room"
    run.mkdir(parents=True)
    job.parent.mkdir()
    job.write_text('scene = {name = "room.glb", poses = ["a.obj", "/b.obj"]}\nlightings.file = "../lamps.json"\n')
    assert load_config(job).scene.name == str(job.with_name("room.glb"))
    config = load_config("jobs/room.toml", {"points.file": "points.json"})
    assert (config.scene.name, config.scene.poses) == ("jobs/room.glb", ("jobs/a.obj", "/b.obj"))
    assert Path(config.lightings.file).resolve() == tmp_path / "lamps.json"
    assert config.points.file == "points.json", "typed, and so from the working folder"
    again = run / "config.toml"
    again.write_text(config.to_toml(Path("runs/room")))
    assert str(tmp_path) not in again.read_text()
    monkeypatch.chdir("/")
    moved = load_config(again)
    assert Path(moved.scene.name).resolve() == job.with_name("room.glb")
    assert [Path(pose).resolve() for pose in moved.scene.poses] == [job.with_name("a.obj"), Path("/b.obj")]
    assert Path(moved.points.file).resolve() == tmp_path / "points.json"
    assert (moved.probes.file, load_config(CONFIGS[0]).scene.name) == ("", "lion")


def test_every_path_counts_from_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Skies, previews, files without an ending, sweeps and scenarios; words for what stands in code stay words."""
    monkeypatch.chdir(tmp_path)
    Path("jobs").mkdir()
    lines = ["lightings = {environment = 'sky.exr', file = 'lamps'}", "export = {gltf = true, gltf_preview = 'lamp.json'}"]
    lines += ["budget.scenario = {environment = 'dusk.hdr', lights = [1, 2]}", "[sweep]", "scene.name = ['a.glb', 'cornell']"]
    Path("jobs/room.toml").write_text("\n".join([*lines, "'lightings.environment' = ['sky.hdr', 'sun-sky']"]))
    config = load_config("jobs/room.toml")
    assert (config.lightings.environment, config.lightings.file) == ("jobs/sky.exr", "jobs/lamps")
    assert config.export.gltf_preview == "jobs/lamp.json"
    assert config.budget.scenario == {"environment": "jobs/dusk.hdr", "lights": [1, 2]}
    assert dict(config.sweep) == {
        "scene.name": ("jobs/a.glb", "cornell"),
        "lightings.environment": ("jobs/sky.hdr", "sun-sky"),
    }
    Path("jobs/again.toml").write_text(config.to_toml(Path("jobs")))
    assert load_config("jobs/again.toml") == config
    Path("jobs/word.toml").write_text("lightings.environment = 'gradient'")
    assert load_config("jobs/word.toml").lightings.environment == "gradient"


def test_paths_count_through_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder of runs that is a link to another disk; a mesh that is one keeps its name."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "disk" / "deep" / "room").mkdir(parents=True)
    Path("runs").symlink_to(tmp_path / "disk" / "deep")
    Path("stored").touch()
    Path("room.glb").symlink_to("stored")
    Path("runs/room/config.toml").write_text(load_config(None, {"scene.name": "room.glb"}).to_toml(Path("runs/room")))
    assert load_config("runs/room/config.toml").scene.name == "room.glb"


FAULTS = {
    "unknown section": ("[fitt]\nbases = 3\n", {}, ["fitt", "unknown key", 'did you mean "fit"?']),
    "unknown key": ("[fit]\nbase = 3\n", {}, ["fit.base", "unknown key", 'did you mean "bases"?']),
    "wrong type": ('[fit]\nbases = "many"\n', {}, ["fit.bases", "got 'many'", "integer"]),
    "out of range": ("[fit]\nbases = 0\n", {}, ["fit.bases", "got 0", "greater than or equal to 1"]),
    "unknown word": ('[fit]\nspace = "lineer"\n', {}, ["fit.space", "'lineer'", 'did you mean "linear"?']),
    "not finite": ("[fit]\nridge = nan\n", {}, ["fit.ridge", "nan"]),
    "negative ridge": ("[fit]\nridge = -1.0\n", {}, ["fit.ridge", "-1.0", "greater than or equal to 0"]),
    "falling range": ("[lightings]\nintensity = [2, 1]\n", {}, ["lightings", "intensity", "lower end first"]),
    "falling region": (
        "[lightings]\nregion_low = [0.5, 0, 0]\nregion_high = [0.4, 1, 1]\n",
        {},
        ["lightings.region_low: got 0.5 for x", "less than 0.4"],
    ),
    "not TOML, what to do": ("[fit\n", {}, ["got text that is not TOML", "expected [section]", "; mend it"]),
    "too small": ("[atlas]\nresolution = 4\n", {}, ["atlas.resolution: got 4", "equal to 8; raise it"]),
    "too large": ("[atlas]\npadding = 65\n", {}, ["atlas.padding: got 65", "equal to 64; lower it"]),
    "one of two kinds of value": (
        "[transport]\nsamples = 0\n",
        {},
        ["transport.samples: got 0, expected 'auto' or greater", "; raise it"],
    ),
    "a wrong type": ('[fit]\ncentre = 3\nbases = "x"\n', {}, ["fit.bases: got 'x'", "leave it out for the default, 16"]),
    "a far word": ('[fit]\nspace = "q"\n', {}, ["fit.space: got 'q'", 'leave it out for the default, "linear"']),
    "a list that is too short": (
        "[lightings]\ndistance = [1.0]\n",
        {},
        ["distance", "leave it out for the default, [1.5, 3.0]"],
    ),
    "saturation": ("[lightings]\nsaturation = [0.5, 1.5]\n", {}, ["lightings.saturation: got [0.5, 1.5]", "; move them"]),
    "cone": ("[lightings]\nspot_outer_deg = [9, 90]\n", {}, ["lightings.spot_outer_deg: got [9, 90]", "; move them"]),
    "no lights": ("[lightings]\nlights = [0, 1]\n", {}, ["lightings.lights: got 0", "at least 1; raise it"]),
    "falling override": ("", {"lightings.intensity": "[2, 1]"}, ["--lightings.intensity: got [2, 1]", "; swap them"]),
    "zero lightings": ("[lightings]\ntrain = 0\n", {}, ["lightings.train", "got 0", "greater than or equal to 1"]),
    "no kinds": ("[lightings]\nkinds = []\n", {}, ["lightings.kinds", "got []", "expected at least 1 entry; mend it"]),
    "a word for a list": ("", {"lightings.kinds": "point"}, ["got 'point', expected a list such as [\"point\"]; mend it"]),
    "a list that lacks an end": ("[lightings]\ndistance = [1.0]\n", {}, ["got [1.0], expected at least 2 entries"]),
    "a list with too many": ("[lightings]\ndistance = [1, 2, 3]\n", {}, ["got [1, 2, 3], expected at most 2 entries"]),
    "an entry is told, its list is not": (
        '[lightings]\nkinds = ["pont"]\n',
        {},
        ["'sphere' or 'environment'; did you mean \"point\"?"],
    ),
    "a list that lacks all": ("[probes]\ngrid = []\n", {}, ["probes.grid: got [], expected at least 3 entries; mend it"]),
    "a list that lacks two": ("[probes]\ngrid = [2]\n", {}, ["probes.grid: got [2], expected at least 3 entries; mend it"]),
    "a word for a list of any length": (
        "",
        {"effects.on": "fog"},
        ["--effects.on: got 'fog', expected a list such as [\"fog\"]; mend it"],
    ),
    "a word for a number or three": (
        '[scene.fog]\nmean_free_path = "thick"\n',
        {},
        ["scene.fog.mean_free_path: got 'thick', expected a number, or one for each of red, green and blue; mend it"],
    ),
    "truth for a number": ("", {"atlas.resolution": "true"}, ["--atlas.resolution: got 'true', expected integer"]),
    "truth for auto or a number": ("[transport]\nsamples = true\n", {}, ["transport.samples: got 'true'", "'auto' or integer"]),
    "truth in a list": ("[lightings]\nlights = [true, 2]\n", {}, ["lightings.lights: got 'true', expected integer"]),
    "a section as a number": ("fit = 3\n", {}, ["fit", "got 3"]),
    "not TOML": ("[fit\n", {}, ["not TOML"]),
    "unknown override": ("", {"fit.basis": "3"}, ["--fit.basis", 'did you mean "fit.bases"?']),
    "bad override": ("", {"fit.bases": "x"}, ["--fit.bases", "got 'x'", "integer"]),
    "override below a value": ("fit = 3\n", {"fit.bases": "3"}, ["--fit.bases"]),
    "a knob of a sweep, by its own name": (
        "[sweep]\nfit.bases = 4\n",
        {},
        ["job.toml: sweep.fit.bases: got 4, expected a list", "; write [4]"],
    ),
    "a knob on the command line": ("", {"sweep.fit.bases": "[]"}, ["--sweep.fit.bases: got [], ", "write [16]"]),
    "a knob that measures, not makes": ("", {"sweep.bench.repeats": "[1]"}, ["--sweep.bench.repeats: got", "; `ddprt bench"]),
    "a knob that nothing is like": ("[sweep]\nzzzz = [1]\n", {}, ["sweep.zzzz: got", "; `ddprt bench --help` lists"]),
    "seed out of range": ("seed = -1\n", {}, ["seed", "got -1"]),
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_one_line(name: str, tmp_path: Path) -> None:
    text, overrides, expected = FAULTS[name]
    path = tmp_path / "job.toml"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        load_config(path, overrides)
    message = str(caught.value)
    assert "\n" not in message
    assert all(part in message for part in expected), message
    assert "job.toml" in message or "--" in message
    got, _, remedy = message.rpartition("; ")
    assert got, f"no word on what to do: {message}"
    assert remedy


def test_truth_values_stay_where_they_belong() -> None:
    config = load_config(None, {"transport.denoise": "true", "methods.settings.mlp": "{residual = true}"})
    assert config.transport.denoise is True
    assert config.methods.settings == {"mlp": {"residual": True}}


@pytest.mark.parametrize("name", ["nothing.toml", ""])
def test_missing_file(name: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected a readable TOML file"):
        load_config(tmp_path / name)


def test_binary_file(tmp_path: Path) -> None:
    path = tmp_path / "job.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="not TOML"):
        load_config(path)


def test_every_setting_is_described() -> None:
    for key in keys():
        model: type = Config
        *parents, leaf = key.split(".")
        for parent in parents:
            model = model.model_fields[parent].annotation
        assert model.model_fields[leaf].description, key


def test_keys_may_be_spelt_as_the_help_prints_them() -> None:
    config = load_config(None, {"transport.target-noise": "0.5", "methods.settings.svd-ridge.bases": "4"})
    assert config.transport.target_noise == 0.5
    assert config.methods.settings == {"svd-ridge": {"bases": 4}}
    with pytest.raises(UserError, match=r"^--transport\.target_noise: got 'much'"):
        load_config(None, {"transport.target-noise": "much"})
