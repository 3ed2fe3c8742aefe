"""Fixtures that every test may use. Nothing is ever written outside a temporary folder."""

from collections.abc import Iterator

import pytest
from hypothesis import settings

from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.library import build
from ddprt.scene.mesh import Scene

settings.register_profile("untimed", deadline=None)  # no test fails because a machine is busy
settings.load_profile("untimed")


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Unwraps of this session, apart from the user's own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DDPRT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def cornell() -> Scene:
    return build("cornell")


@pytest.fixture(scope="session")
def corridor() -> Scene:
    return build("corridor")


@pytest.fixture(scope="session")
def furnace() -> Scene:
    return build("furnace", subdivisions=3)


@pytest.fixture(scope="session")
def plates() -> Scene:
    return build("plates")


@pytest.fixture(scope="session")
def statue() -> Scene:
    return build("statue", subdivisions=3)


@pytest.fixture(scope="session")
def cornell_atlas(cornell: Scene) -> Atlas:
    return build_atlas(cornell, 64)


@pytest.fixture(scope="session")
def furnace_atlas(furnace: Scene) -> Atlas:
    return build_atlas(furnace, 64)


@pytest.fixture(scope="session")
def plates_atlas(plates: Scene) -> Atlas:
    return build_atlas(plates, 64)
