"""``armlab record``: listen to one or more robots and write a log. Sends nothing, ever."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

import armlab
from armlab.cli import FAILED
from armlab.cli.support.options import Force, known_ports, ports_in, require_positive
from armlab.cli.support.output import Narrator, check_output, note, result
from armlab.errors import ConfigError, NoRobot, SessionEnded

if TYPE_CHECKING:
    from armlab.robots import Robot


def record(
    *robot: str,
    port: str | None = None,
    output: Annotated[Path, Parameter(alias="-o")],
    lead_through: bool = False,
    seconds: float | None = None,
    patience: float | None = None,
    force: Force = False,
) -> int:
    """Record what robots send over EGM. Nothing is sent to them, so nothing here can move them.

    Ends after --seconds of packets, after --patience without any, or on Ctrl-C: the log then holds every packet that
    came. A process that is killed outright loses what it had not taken up yet, a packet or two; a loss of power costs
    up to 0.8 s.

    Parameters:
        robot: Names in the library, or robot files; one log each.
        port: UDP ports to listen on, one per robot, separated by commas; those of the settings when not given, else
            6510 for one robot, 6511, 6512, ... for several.
        output: The log, run.mcap; with several robots each has its side or name added: runleft.mcap, runright.mcap.
        lead_through: The arm is led by hand: lists the steps first and says when it does not begin in its home posture.
        seconds: Robot time after which to end [s], counted from the first packet.
        patience: Give up when no packet comes for so long [s]; waits for ever when not given.
    """
    from armlab.bridge.control.recording import paths

    arms = [armlab.robots.load(name) for name in robot]
    urls = _urls(port, arms)
    require_positive("seconds", seconds, "s")
    require_positive("patience", patience, "s")
    files = [path for path in paths(output, arms) if path is not None]
    for path in files:
        check_output(path, force, [".mcap"])
    if lead_through:
        note(_STEPS)
    home = {arm.name: arm.q_home.tolist() for arm in arms} if lead_through else {}
    listener = Narrator(listens=True, q_home=home)
    limit = float("inf") if patience is None else patience
    with armlab.bridge.connect(urls, arms, patience=limit) as link:
        note(f"Listening on UDP port {', '.join(map(str, link.ports))}; Ctrl-C ends the recording.")
        for path in files:
            path.unlink(missing_ok=True)
        try:
            link.run(None, seconds=seconds, record=output, feeds=[listener])
        except KeyboardInterrupt:
            note("Ended by the user.")
        except NoRobot:
            _told(files)
            raise
        except SessionEnded as error:
            note(str(error))
    return _told(files)


_STEPS = """Leading by hand, step by step:
  1. Manual mode, motors off. RAPID from main: ArmlabStream.mod, which streams and moves nothing.
  2. Start it at the home posture. This program says when packets come.
  3. Stop RAPID and switch lead-through on: on the pendant, or by SetLeadThrough \\On. Whether packets go on after the
     stop depends on the controller; if they end, switch lead-through on in RAPID before it streams.
  4. Move the arm by hand. Ctrl-C here ends the log.
  5. Motors off before RAPID starts again."""


def _urls(port: str | None, arms: list[Robot]) -> list[str]:
    """Return one link per arm, on all network interfaces."""
    if not arms:
        raise ConfigError("Expected the name of a robot, got none. Try `armlab record yumi_left -o run.mcap`.")
    numbers = known_ports(arms) if port is None else ports_in(port)
    if len(numbers) != len(arms):
        raise ConfigError(f"Expected one port per robot, such as --port 6511,6512, got {port!r} for {len(arms)}.")
    return [f"egm://0.0.0.0:{number}" for number in numbers]


def _told(files: list[Path]) -> int:
    """Say what the logs hold; a log without a row is removed. Return the exit code."""
    kept = 0
    for path in files:
        table = armlab.log.read(path)
        is_whole = bool(armlab.log.inspect(path).summary)  # one that was not finished misses what came last
        if len(table) or not is_whole:
            kept += is_whole
            result(f"{path}: {len(table)} packets, {table.t[-1] - table.t[0] if len(table) else 0.0:.2f} s")
        else:
            path.unlink()
            note(f"No packet came for {path}: no file was kept. Ask: armlab doctor")
    return 0 if kept == len(files) else FAILED
