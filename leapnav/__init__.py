"""A wheeled-robot navigation benchmark in which the optimum is known.

`import leapnav` registers the environments and imports nothing heavy. The packages are `leapnav.envs`,
`leapnav.experts` and `leapnav.training`.
"""

from importlib.metadata import version
from pkgutil import extend_path

import gymnasium

__all__ = ["__version__"]

# In the repository the packages are beside this directory. With an editable install, or when Python is started in the
# repository, this directory is found first, and the directories of the installed package are added here.
__path__ = extend_path(__path__, __name__)
__version__ = version("leapnav")

for _name, _module in (("Navigate", "navigation"), ("NavigateGoal", "goal_navigation")):
    if f"leapnav/{_name}-v0" not in gymnasium.registry:  # a subprocess worker imports the package again
        gymnasium.register(
            f"leapnav/{_name}-v0",
            entry_point=f"leapnav.envs.{_module}:{_name}Env",
            vector_entry_point=f"leapnav.envs.vector:{_name}VectorEnv",
        )
