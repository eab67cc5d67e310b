"""A wheeled-robot navigation benchmark in which the optimum is known.

`import leapnav` registers the environments and loads nothing heavy; the parts are `leapnav.envs`, `leapnav.experts` and
`leapnav.training`.
"""

from importlib.metadata import version
from pkgutil import extend_path

import gymnasium

__all__ = ["__version__"]

# The parts stand beside this folder in the repository. From there, with a strict editable install or a plain one, this
# folder is found first; the installed package's other folders join it.
__path__ = extend_path(__path__, __name__)
__version__ = version("leapnav")

# Gymnasium's wrappers would hide `compute_reward`; what they check, the environment checks itself.
_BARE = {"order_enforce": False, "disable_env_checker": True}
for _name, _options in (("Navigate", {}), ("NavigateGoal", _BARE)):
    if f"leapnav/{_name}-v0" not in gymnasium.registry:  # subprocess workers import again
        gymnasium.register(
            f"leapnav/{_name}-v0",
            entry_point=f"leapnav.envs.navigation:{_name}Env",
            vector_entry_point=f"leapnav.envs.vector:{_name}VectorEnv",
            **_options,
        )
