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

for _name in ("Navigate", "NavigateGoal"):
    if f"leapnav/{_name}-v0" not in gymnasium.registry:  # subprocess workers import again
        # Gymnasium's wrappers hide `compute_reward`; what they check, the environment checks itself.
        _wrapped = _name == "Navigate"
        gymnasium.register(
            f"leapnav/{_name}-v0",
            entry_point=f"leapnav.envs.navigation:{_name}Env",
            vector_entry_point=f"leapnav.envs.vector:{_name}VectorEnv",
            order_enforce=_wrapped,
            disable_env_checker=not _wrapped,
        )
