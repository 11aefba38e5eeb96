"""Register the tasks of one agent with Gymnasium, without importing Gymnasium for it.

Gymnasium finds no environments of installed packages by itself (its plugins ended with version 1):
somebody has to call `gymnasium.register`. `import surgisoft` does, at once where Gymnasium is
imported already, else as soon as it is.
"""

import importlib.util
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType

ONE_AGENT = ("track_circle", "track_square", "track_body", "laser_plane", "keyhole")
"""Tasks of one agent; `surgisoft.tasks` builds them."""


def register() -> None:
    """Register `surgisoft/NAME-v0` for each task of one agent; what is registered stays."""
    import gymnasium

    for name in ONE_AGENT:
        if f"surgisoft/{name}-v0" not in gymnasium.registry:
            gymnasium.register(
                f"surgisoft/{name}-v0",
                entry_point="surgisoft.tasks.single:SingleEnv",
                vector_entry_point="surgisoft.tasks.single:BatchedEnv",
                kwargs={"task": name},
            )


class _AfterGymnasium:
    """Import hook that registers the environments when Gymnasium has been imported."""

    def find_spec(self, name: str, path=None, target=None) -> ModuleSpec | None:
        """The spec of Gymnasium with a loader that registers afterwards; None for all else."""
        if name != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is None or spec.loader is None:
            return None
        execute = spec.loader.exec_module

        def execute_and_register(module: ModuleType) -> None:
            execute(module)
            register()

        spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]  # wrapped
        return spec


def register_with_gymnasium() -> None:
    """Register the environments now, or when Gymnasium is imported."""
    if "gymnasium" in sys.modules:
        register()
    else:
        sys.meta_path.insert(0, _AfterGymnasium())
