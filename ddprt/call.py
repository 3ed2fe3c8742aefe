"""What was typed after a verb, and the run that it means."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ddprt.errors import UserError


@dataclass
class Call:
    """What was typed after the verb."""

    verb: str
    files: list[str] = field(default_factory=list)
    options: dict[str, str] = field(default_factory=dict)
    overrides: dict[str, str] = field(default_factory=dict)
    command: str = ""

    @property
    def quiet(self) -> bool:
        """Whether progress is hidden."""
        return "quiet" in self.options

    def asks(self, flag: str) -> bool:
        """Whether a flag was given."""
        return flag in self.options

    def file(self, what: str) -> str:
        """The one file argument."""
        if len(self.files) != 1:
            raise UserError(f"ddprt {self.verb}: got {len(self.files)} files, expected {what}; see `ddprt {self.verb} --help`")
        return self.files[0]

    def run(self) -> Any:
        """The run folder and configuration that the arguments mean."""
        from ddprt.config import load_config

        source = self.file("a configuration such as configs/cornell.toml")
        if _is_scene(source):
            raise UserError(
                f"ddprt {self.verb}: got the scene {source}, expected a configuration; "
                f"write ddprt {self.verb} configs/cornell.toml --scene.name {source}"
            )
        config = load_config(source, self.overrides)
        default = Path(source).parent if Path(source).name == "config.toml" else Path("runs") / Path(source).stem
        if config.animated:
            from ddprt.pipeline_animation import AnimatedRun as Run
        else:
            from ddprt.pipeline import Run  # type: ignore[assignment]
        return Run(config, Path(self.options.get("out") or default), command=self.command, quiet=self.quiet)


def _is_scene(source: str) -> bool:
    """Whether a scene stands where a configuration should."""
    from ddprt.scene.files import SUFFIXES
    from ddprt.scene.library import SCENES

    return Path(source).suffix.lower() in SUFFIXES or (source in SCENES and not Path(source).is_file())
