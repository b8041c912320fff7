"""Identify one model from many logs in two processes; a damaged log is skipped and listed."""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from armlab import bridge, fleet, identify, robots


def main() -> None:
    robot = robots.load("yumi_right")
    folder = Path("logs")
    folder.mkdir(exist_ok=True)
    for k in range(3):  # simulate the recordings of three days
        motion = identify.design_excitation(robot, seconds=15.0, seed=k)
        with bridge.connect(f"sim://yumi_right?lockstep=true&seed={k}", robot) as link:
            link.run(motion.controller(approach=3.0), seconds=18.0, record=folder / f"day{k}.mcap")
    (folder / "torn.mcap").write_bytes(b"the disk was full")

    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        found = fleet.identify(folder, robot, pool)
    print(found.report())
    print("saved", found.fit.save("model.toml"))


if __name__ == "__main__":
    main()
