"""Checks that a configuration only names methods and settings that exist, before anything long starts."""

from ddprt.config import Config
from ddprt.methods import make_method


def check_names(config: Config) -> None:
    """Makes every method that a run will need, and drops it.

    Raises:
      UserError: unknown method or setting, wrong type or range.
    """
    named = {config.fit.method, *config.methods.compare, *config.methods.settings}
    for name in sorted(named):
        make_method(name, config.fit.model_dump(exclude={"method", "points"}), config.methods.settings.get(name, {}))
