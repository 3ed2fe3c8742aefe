"""The scene that a configuration asks for: read, with effects forced, and with the lightmap layout that it takes."""

from ddprt.config import Config
from ddprt.scene.files import load_scene
from ddprt.scene.mesh import Scene
from ddprt.scene.own_charts import charted
from ddprt.transport.effects import force


def configured_scene(config: Config) -> Scene:
    """The scene of a configuration, with the effects that it forces and the lightmap layout that it takes.

    Of an animation it is the first pose.
    """
    asked, atlas = config.scene, config.atlas
    if config.animated:
        from ddprt.scene.poses import configured_animation  # most scenes stand still

        scene = configured_animation(config).key(0)
    else:
        scene = load_scene(asked.name, fog=asked.fog.given, **asked.parameters)
    return charted(force(scene, on=config.effects.on, off=config.effects.off), atlas.use, atlas.resolution, atlas.padding)
