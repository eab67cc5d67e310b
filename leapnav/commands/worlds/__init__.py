"""`leapnav worlds import|benchmark`: the worlds of other benchmarks."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from leapnav.commands.worlds.benchmark import Benchmark
from leapnav.commands.worlds.import_worlds import Import


@dataclass(frozen=True)
class Worlds:
    """Read the worlds of other benchmarks, and score policies and the expert in them."""

    action: tyro.conf.OmitSubcommandPrefixes[
        Annotated[
            Annotated[Import, tyro.conf.subcommand("import")] | Annotated[Benchmark, tyro.conf.subcommand("benchmark")],
            tyro.conf.arg(name=""),
        ]
    ]
