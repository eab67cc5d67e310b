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

_ENVIRONMENT = "leapnav/Navigate-v0"
if _ENVIRONMENT not in gymnasium.registry:  # subprocess workers import again
    gymnasium.register(_ENVIRONMENT, entry_point="leapnav.envs.navigation:NavigateEnv")
