"""`leapnav play`: the interactive page in a browser."""

from __future__ import annotations

import errno
import socket
import threading
import webbrowser
from dataclasses import dataclass
from pathlib import Path

INITIAL_SCENARIO = ("clutter", 7)  # family and index in its test bank
ALL_INTERFACES = ("0.0.0.0", "::")


@dataclass(frozen=True)
class Play:
    """Drag start, goal and obstacles in a browser and see the optimum follow, beside the paths of policies."""

    scenario: Path | None = None
    """Initial scenario file (JSON); by default a scenario of the test bank."""
    policies: tuple[str, ...] = ()
    """Directories of additional policies or runs; the included policies are always available."""
    port: int = 8765
    """Port of the server; 0 for any free one."""
    host: str = "127.0.0.1"
    """Address of the server. The default is reachable from this machine only; there is no password."""
    browser: bool = True
    """Open the page in a browser."""

    def run(self) -> int:
        """Serve the page until interrupted."""
        try:
            import uvicorn

            from leapnav.play.server import create_app
        except ModuleNotFoundError as error:
            if error.name not in ("starlette", "uvicorn"):
                raise
            raise OSError('the page needs a web server: pip install "leapnav[play]"') from None
        from leapnav.envs.scenarios.scenario import Scenario
        from leapnav.envs.utils.validation import check_integer
        from leapnav.play.solving import PlaySolver, bank_scenario
        from leapnav.training.policies.files import shipped_policies
        from leapnav.training.scoring.policy_specs import BASELINES, load_policy_spec

        check_integer("port", self.port, 0, 65535)
        scenario = bank_scenario(*INITIAL_SCENARIO) if self.scenario is None else Scenario.from_json(self.scenario)
        for policy in self.policies:
            load_policy_spec(policy)
        names = tuple(dict.fromkeys((*self.policies, *shipped_policies(), *BASELINES)))
        app = create_app(PlaySolver(names), scenario, self.host)
        with self._listen() as listener:
            address = f"http://{self._browser_host()}:{listener.getsockname()[1]}"
            print(f"leapnav play: {address} (Ctrl-C stops the server)", flush=True)
            if self.browser:
                threading.Timer(0.5, webbrowser.open, [address]).start()
            uvicorn.Server(uvicorn.Config(app, log_level="warning")).run([listener])
        return 0

    def _browser_host(self) -> str:
        """The host as a browser on this machine addresses it."""
        host = "127.0.0.1" if self.host in ALL_INTERFACES else self.host
        return f"[{host}]" if ":" in host else host

    def _listen(self) -> socket.socket:
        try:
            family, *_, address = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)[0]
            listener = socket.create_server(address[:2], family=family)
        except socket.gaierror:
            raise ValueError(f"host: expected an address of this machine, got {self.host!r}") from None
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise ValueError(f"port: {self.port} is in use; --port 0 selects a free one") from None
            raise ValueError(f"host: cannot listen at {self.host!r}: {error.strerror}") from None
        # asyncio disables Nagle's algorithm only on sockets that name their protocol; with it, a response takes 40 ms
        # longer.
        return socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP, fileno=listener.detach())
