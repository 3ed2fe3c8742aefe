"""All engines that can be written for."""

from ddprt.catalogue import Catalogue
from ddprt.export.engines.engine import Engine
from ddprt.export.engines.shader import GDSHADER, GLSL, UNITY, UNREAL

ENGINES: Catalogue[Engine] = Catalogue(
    "engine",
    {
        "unity": Engine(
            ("unity/README.md", "unity/DdprtModel.cs", "unity/DdprtLightmap.cs", "unity/DdprtCompose.compute"),
            {"unity/Ddprt.hlsl": UNITY},
        ),
        "unreal": Engine(("unreal/README.md", "c/ddprt_runtime.h"), {"unreal/Ddprt.ush": UNREAL}),
        "godot": Engine(("godot/README.md", "godot/ddprt_lightmap.gd"), {"godot/ddprt.gdshader": GDSHADER}),
        "three": Engine(
            ("three/README.md", "three/model.js", "three/lightmap.js", "three/package.json"), {"three/compose.frag": GLSL}
        ),
        "c": Engine(("c/README.md", "c/ddprt_runtime.h", "c/check.c"), {}),
    },
)
"""What may stand in `export.engines`."""
