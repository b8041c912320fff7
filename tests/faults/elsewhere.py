"""Cells of the matrix that tests of other folders hold."""

from __future__ import annotations

from .matrix import cells, held_by

UNFINISHED = "was not finished"
LEASE = "… no longer commands …: silent for 0.1 s. The arm holds."

held_by(
    "tests/bridge/control/test_loop.py::test_a_flood_of_garbage_changes_no_reference",
    cells(
        "network",
        "a flood of garbage from a stranger",
        "running",
        "what is sent is the same, bit for bit",
        "Dropped a datagram from …",
        "nothing to recover",
    ),
)
held_by(
    "tests/bridge/control/test_motion_limits.py::test_a_robot_that_streams_slower_than_it_guides",
    cells(
        "robot",
        "the cycle time changes from 24 to 4 ms, or back",
        "holding",
        "the step of each reference is the time that the robot measured",
        "The cycle time of the robot changed from … to … ms.",
        "nothing to recover",
    ),
)
held_by(
    "tests/bridge/net/test_hostile_datagrams.py::test_a_million_mutated_datagrams",
    cells(
        "network",
        "a million mutated datagrams",
        "holding",
        "nothing raises, nothing grows, the reference does not move",
        "Dropped a datagram from …",
        "nothing to recover",
    ),
)
held_by(
    "tests/bridge/control/test_loop_by_hand.py::test_a_stop_of_which_the_system_sends_nothing_ends_the_run",
    cells(
        "network",
        "the system refuses to send for two seconds",
        "stopping",
        "the run ends; the robot keeps the last reference until its own time-out",
        "Expected the replies that bring the arm to rest to go out",
        "another run",
    ),
)
held_by(
    "tests/bridge/control/test_multi_arm.py::test_an_arm_that_falls_silent_holds_the_other",
    cells(
        "network",
        "one arm of two falls silent",
        "running",
        "the other holds",
        "Session … ended: …",
        "when both are there",
    ),
)
held_by(
    "tests/cli/test_record.py::test_a_recording_that_is_ended_from_outside",
    cells(
        "process",
        "kill -9 of `armlab record`",
        "listening",
        "nothing was ever sent; the log has what was written down",
        UNFINISHED,
        "`armlab log recover` makes it whole",
    ),
)
held_by(
    "tests/log/test_recording_file.py::test_kill_9_loses_a_few_rows",
    cells(
        "process",
        "kill -9 of a process that records",
        "running",
        "the log lacks the last hundredths of a second",
        UNFINISHED,
        "`armlab log recover` makes it whole",
    ),
)
held_by(
    "tests/bridge/control/test_multi_arm_simulated.py::test_both_files_survive_a_kill",
    cells(
        "process",
        "kill -9 of a bridge of two arms",
        "running",
        "the logs of both arms can be read",
        UNFINISHED,
        "`armlab log recover` makes it whole",
    ),
)
held_by(
    "tests/bridge/test_clients_that_fail.py::test_a_commander_that_dies_or_stands_still_loses_the_arm_and_another_takes_it",
    cells(
        "process",
        "kill -9 of a client that commands",
        "running",
        "the arm holds after 0.1 s",
        LEASE,
        "another client takes it",
    ),
    cells(
        "process",
        "a client that commands stands still",
        "running",
        "the arm holds after 0.1 s",
        LEASE,
        "another client takes it; what the first says later is refused",
    ),
)
held_by(
    "tests/bridge/test_two_commanders.py::test_one_commands_at_any_instant_whoever_dies",
    cells(
        "process",
        "two commanders, killed at random",
        "running",
        "one of them commands at any instant; no jump when the other takes over",
        "… no longer commands …",
        "whoever asks next",
    ),
)
held_by(
    "tests/bridge/test_clients_that_fail.py::test_a_reader_that_stands_still_disturbs_nobody_and_sees_what_it_missed",
    cells(
        "process",
        "a client that reads stands still",
        "running",
        "the loop and other clients lose nothing; it is told how many rows it missed",
        "–",
        "when it goes on",
    ),
)
held_by(
    "tests/bridge/servers/rosbridge/test_clients.py::test_one_client_reads_while_the_others_are_lost",
    cells(
        "process",
        "web clients stopped, killed, or cut off",
        "running",
        "the loop and other clients lose nothing; who is lost is closed",
        "To its clients: … dropped",
        "they connect again",
    ),
)
held_by(
    "tests/bridge/servers/test_supervisor.py::test_a_killed_server_starts_again",
    cells(
        "process",
        "kill -9 of a server",
        "running",
        "the loop goes on without it",
        "The server … ended with status -9. It starts again in …",
        "it starts again",
    ),
)
held_by(
    "tests/bridge/test_link.py::test_ctrl_c_stops_the_arm_first_and_completes_the_log",
    cells(
        "process",
        "Ctrl-C or SIGTERM",
        "running",
        "the arm comes to rest, the log is finished",
        "Stopping: interrupted.",
        "the next run",
    ),
)
held_by(
    "tests/bridge/control/test_loop.py::test_a_busy_controller_is_answered_for_by_the_guard",
    cells(
        "controller",
        "is busy for 0.3 s, in real time",
        "running",
        "the guard's thread answers in its place: hold",
        "The controller was too slow: one call took …",
        "the next run",
    ),
)
held_by(
    "tests/bridge/control/test_loop_by_hand.py::test_a_call_that_hangs_is_told_once_after_a_second",
    cells(
        "controller",
        "never returns",
        "running",
        "the guard holds the arm; Ctrl-C breaks the call off and the arm comes to rest",
        "The controller has not returned for 1 s; …",
        "Ctrl-C, then the next run",
    ),
)
held_by(
    "tests/bridge/test_link.py::test_an_error_outside_the_controller_stops_the_arm_first",
    cells(
        "controller",
        "a codec of your own raises",
        "running",
        "the arm comes to rest, and the run ends",
        "Expected a cycle without errors, got …",
        "the next run",
    ),
)
held_by(
    "tests/bridge/inputs/test_fusion.py::test_a_source_that_breaks_its_promises_grows_old",
    cells(
        "controller",
        "a source of your own raises, or gives something else",
        "running",
        "its last reading stays and grows old; the arm holds where the source is required",
        "The source … has a problem",
        "with its next reading",
    ),
)
held_by(
    "tests/bridge/inputs/test_fusion.py::test_a_reading_that_is_none_does_not_stop_the_loop",
    cells(
        "controller",
        "a source gives a number or a stamp that is none",
        "running",
        "its last reading stays; nothing raises",
        "The source … has a problem",
        "with its next reading",
    ),
)
held_by(
    "tests/bridge/inputs/test_fusion.py::test_a_required_source_that_is_stale_holds_the_arm",
    cells(
        "controller",
        "a required source falls silent",
        "running",
        "the arm holds after the source's `max_age`",
        "The source … is stale",
        "with its next reading",
    ),
)
held_by(
    "tests/log/test_recorder.py::test_a_disk_that_is_slow_to_sync_holds_up_no_row",
    cells(
        "disk",
        "is slow to sync",
        "running",
        "rows are written meanwhile; a kill loses none of them",
        "–",
        "with the disk",
    ),
)
