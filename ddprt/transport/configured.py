"""The scene that a configuration asks for: read, with effects forced, and with the lightmap layout that it takes."""

from ddprt.config import Config
from ddprt.errors import UserError
from ddprt.scene.files import load_scene
from ddprt.scene.mesh import Scene
from ddprt.scene.own_charts import charted
from ddprt.sections import AnimationConfig
from ddprt.transport.effects import force


def configured_scene(config: Config) -> Scene:
    """The scene of a configuration, with the effects that it forces and the lightmap layout that it takes.

    Of an animation it is the first pose.

    Raises:
      UserError: there is no such scene, or [animation] says how something moves, and not at how many keyframes.
    """
    asked, atlas = config.scene, config.atlas
    if config.animated:
        from ddprt.scene.poses import configured_animation  # most scenes stand still

        scene = configured_animation(config).key(0)
    else:
        _refuse_idle(config.animation)
        scene = load_scene(asked.name, fog=asked.fog.given, **asked.parameters)
    return charted(force(scene, on=config.effects.on, off=config.effects.off), atlas.use, atlas.resolution, atlas.padding)


def _refuse_idle(asked: AnimationConfig) -> None:
    """Who names a clip and no keyframes would be baked a scene that stands still, and think that it moves."""
    made = [name for name in AnimationConfig.model_fields if name in asked.model_fields_set]
    if made and "keys" not in made and asked != AnimationConfig():
        raise UserError(
            f"animation.keys: got none beside animation.{made[0]}, expected how many; set animation.keys = 5, or 0 for a scene "
            "that stands still"
        )
