"""``armlab record``: record one or more robots. Sends nothing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import armlab
from armlab.cli import FAILED
from armlab.cli.support.options import Force, Output, known_ports, load_robot, ports_in, require_positive
from armlab.cli.support.output import Narrator, check_output, note, result
from armlab.errors import ConfigError, NoRobot, SessionEnded

if TYPE_CHECKING:
    from armlab.robots import Robot


def record(
    *robot: str,
    port: str | None = None,
    output: Output,
    lead_through: bool = False,
    seconds: float | None = None,
    patience: float | None = None,
    force: Force = False,
) -> int:
    """Record the EGM data of robots. The command sends nothing, so it cannot move the robots.

    Ends after receiving packets for --seconds, after receiving none for --patience, or on Ctrl-C. The log then contains
    every received packet. If the process is killed, one or two packets are lost; a power failure loses up to 0.8 s of
    data.

    Parameters:
        robot: Library names or robot files; each robot has its own log.
        port: UDP ports to listen on, one per robot, separated by commas; default: from the settings, otherwise 6510 for
            one robot, 6511, 6512, ... for several.
        output: Log file, such as run.mcap; with several robots, the side or name is appended: runleft.mcap,
            runright.mcap.
        lead_through: Print the steps of lead-through (hand guiding) first, and warn if the arm does not start in its
            home posture.
        seconds: Stop after this time [s], measured by the robot's clock from the first packet.
        patience: Give up after this time without packets [s]; default: wait indefinitely.
    """
    from armlab.bridge.control.recording import paths

    arms = [load_robot(name) for name in robot]
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


_STEPS = """Lead-through, step by step:
  1. Select manual mode with motors off, and move the program pointer to main in ArmlabStream.mod, which only streams.
  2. Start RAPID with the arm in its home posture. This program reports the first packet.
  3. Stop RAPID and switch on lead-through, either on the pendant or with SetLeadThrough \\On. Some controllers stop
     sending packets at this point; in this case, switch lead-through on in RAPID before streaming starts.
  4. Move the arm by hand. Ctrl-C ends the recording.
  5. Switch the motors off before you start RAPID again."""


def _urls(port: str | None, arms: list[Robot]) -> list[str]:
    """Return one link URL per arm; the links listen on all network interfaces."""
    if not arms:
        raise ConfigError("Expected the name of a robot, got none. For example: armlab record yumi_left -o run.mcap.")
    numbers = known_ports(arms) if port is None else ports_in(port)
    if len(numbers) != len(arms):
        raise ConfigError(
            f"Expected one port per robot, such as --port 6511,6512, got {port!r} for {len(arms)} robots."
        )
    return [f"egm://0.0.0.0:{number}" for number in numbers]


def _told(files: list[Path]) -> int:
    """Report the size of each log, remove logs without rows, and return the exit code."""
    kept = 0
    for path in files:
        table = armlab.log.read(path)
        is_whole = bool(armlab.log.inspect(path).summary)  # an unfinished log lacks its last rows
        if len(table) or not is_whole:
            kept += is_whole
            result(f"{path}: {len(table)} packets, {table.t[-1] - table.t[0] if len(table) else 0.0:.2f} s")
        else:
            path.unlink()
            note(f"No packets received for {path}, so the file was removed. Check the network: armlab doctor")
    return 0 if kept == len(files) else FAILED
