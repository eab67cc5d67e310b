"""`leapnav export`: policies for programs without Python."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from leapnav.commands.options import EnvironmentOption, PolicyName, parse_environment
from leapnav.outputs import check_outputs


@dataclass(frozen=True)
class Export:
    """Export the deterministic actor of a policy to ONNX.

    The file FILE.json beside it lists names, units, order and bounds of the observation and of the action.
    """

    policy: Annotated[tyro.conf.Positional[PolicyName], tyro.conf.arg(metavar="POLICY")]
    """Included policy (clutter, ...), directory of a policy or of a run, or model of Stable-Baselines3 (.zip)."""
    onnx: Path
    """Output file (.onnx)."""
    env: EnvironmentOption = ()
    """Arguments of the environment (KEY=VALUE) with which a model of Stable-Baselines3 was trained; by default derived
    from its observation space."""

    def run(self) -> int:
        """Export the policy."""
        check_outputs(onnx=self.onnx)
        from leapnav.training.policies.onnx_export import export_onnx

        description = export_onnx(self.policy, self.onnx, parse_environment(self.env))
        print(f"wrote {self.onnx} and {description}")
        return 0
