"""The page of `ddprt inspect`: what its pictures show of texels, and that it opens from disk."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from small_job import call

import ddprt.pipeline_inspect
from ddprt.report.inspection import densities, inspection_page, shown
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer


def test_pictures_show_what_they_say(cornell_atlas: Atlas) -> None:
    atlas = cornell_atlas
    found = {one.name: one for one in shown(atlas)}
    row, column = np.divmod(atlas.texel, atlas.resolution)
    bright = found["Checker"].colours.max(1)
    for chart in np.unique(atlas.chart):
        own = atlas.chart == chart
        even = (row[own] // 4 + column[own] // 4) % 2 == 0
        assert len(np.unique(found["Checker"].colours[own], axis=0)) <= 2
        if even.any() and not even.all():
            assert bright[own][even].min() > bright[own][~even].max()
    assert f"{len(np.unique(atlas.chart))} charts" in found["Checker"].told
    np.testing.assert_allclose(2 * found["Normals"].colours - 1, atlas.normal)
    dense = atlas.area < np.median(atlas.area / atlas.coverage) * atlas.coverage / 8  # eight times the texels of the middle
    red, blue = found["Density"].colours[..., 0], found["Density"].colours[..., 2]
    assert (red[dense] > blue[dense]).all()
    assert found["Overlaps"].told.startswith(f"Red: 0 of {atlas.count} texels")
    twice = replace(atlas, coverage=atlas.coverage + np.eye(1, atlas.count)[0])
    lapped = next(one for one in shown(twice) if one.name == "Overlaps")
    assert lapped.told.startswith(f"Red: {int(atlas.coverage[0] > 0.01)} of")
    assert (lapped.colours[0, 0] > 2 * lapped.colours[0, 1]) == (atlas.coverage[0] > 0.01)


def test_density_is_texels_along_a_metre(cornell_atlas: Atlas) -> None:
    half = replace(cornell_atlas, area=cornell_atlas.coverage / 25.0)
    np.testing.assert_allclose(densities(half), 5.0)
    (dense,) = (one for one in shown(half) if one.name == "Density")
    np.testing.assert_allclose(dense.colours, 1.0)  # all as the mean: white
    assert "White: 5 texels per metre" in dense.told


def test_the_page_opens_from_disk(cornell: Scene, cornell_atlas: Atlas) -> None:
    page = inspection_page(cornell, Tracer.of(cornell), cornell_atlas, "scene       a <b>\n            and more")
    assert page.count("data:image/png;base64,") == 2 * len(shown(cornell_atlas))
    assert not re.search(r"(src|href)=\"(?!data:)", page)
    assert "<td>scene</td><td>a &lt;b&gt;</td>" in page
    assert '<tr class="more"><td></td><td>and more</td>' in page


def test_inspect_writes_and_opens_a_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, opened = SimpleNamespace(text="scene", page=lambda: "<html>"), list[str]()
    monkeypatch.setattr(ddprt.pipeline_inspect, "examine", lambda source, overrides: made)
    monkeypatch.setattr("webbrowser.open", opened.append)
    assert call("inspect", "cornell", "--html", tmp_path / "a.html") == 0
    assert (tmp_path / "a.html").read_text() == "<html>"
    assert opened == []
    assert call("inspect", "cornell", "--html", tmp_path / "b.html", "--open") == 0
    assert opened == [(tmp_path / "b.html").as_uri()]
    assert call("inspect", "cornell", "--open") == 0
    assert opened[1].endswith("inspect.html")
    assert call("inspect", "cornell", "--html", tmp_path / "a.txt") == 2
