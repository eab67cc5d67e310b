"""`leapnav play`: the page's command."""

from __future__ import annotations

import errno
import socket
import threading
import webbrowser
from dataclasses import dataclass
from pathlib import Path

EXTRA = 'the page needs a web server: pip install "leapnav[play]"'
SCENARIO = ("clutter", 7)  # of the test bank, shown first
PUBLIC = ("0.0.0.0", "::")


@dataclass(frozen=True)
class Play:
    """Drag start, goal and obstacles in a browser and see the optimum follow, with policies beside it."""

    scenario: Path | None = None
    """Scenario file (JSON) to begin with; by default one of the test bank."""
    policies: tuple[str, ...] = ()
    """Folders of policies or runs that may drive, beside those that ship."""
    port: int = 8765
    """Port; 0 takes a free one."""
    host: str = "127.0.0.1"
    """Address to listen at. The default is for this machine alone; there is no password."""
    browser: bool = True
    """Open the page in a browser."""

    def run(self) -> int:
        """Serves the page until it is interrupted."""
        try:
            import uvicorn

            from leapnav.play.server import create_app
        except ModuleNotFoundError as error:
            if error.name not in ("starlette", "uvicorn"):
                raise
            raise OSError(EXTRA) from None
        from leapnav.envs.scenario import Scenario
        from leapnav.play.answers import Answers, banked
        from leapnav.training.entrants import BASELINES, load_entrant
        from leapnav.training.policies import shipped_policies

        if not 0 <= self.port < 65536:
            raise ValueError(f"port: expected 0 to 65535, got {self.port}")
        scenario = banked(*SCENARIO) if self.scenario is None else Scenario.from_json(self.scenario)
        for policy in self.policies:
            load_entrant(policy)
        names = tuple(dict.fromkeys((*self.policies, *shipped_policies(), *BASELINES)))
        app = create_app(Answers(names), scenario, self.host)
        with self._listen() as listener:
            address = f"http://{self._shown()}:{listener.getsockname()[1]}"
            print(f"leapnav play: {address} (Ctrl-C ends it)", flush=True)
            if self.browser:
                threading.Timer(0.5, webbrowser.open, [address]).start()
            uvicorn.Server(uvicorn.Config(app, log_level="warning")).run([listener])
        return 0

    def _shown(self) -> str:
        host = "127.0.0.1" if self.host in PUBLIC else self.host
        return f"[{host}]" if ":" in host else host

    def _listen(self) -> socket.socket:
        try:
            family, *_, address = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)[0]
            return socket.create_server(address[:2], family=family)
        except socket.gaierror:
            raise ValueError(f"host: expected an address of this machine, got {self.host!r}") from None
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise ValueError(f"port: {self.port} is in use; --port 0 takes a free one") from None
            raise ValueError(f"host: cannot listen at {self.host!r}: {error.strerror}") from None
