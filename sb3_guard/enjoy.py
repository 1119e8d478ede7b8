"""Play a trained agent: ``sb3-guard enjoy --algo cpo --env Goal_Point_8Hazards``."""

import os
import sys

from sb3_guard.zoo.agents.flags import EnjoyFlags as Flags
from sb3_guard.zoo.cli.flags import command


def enjoy(flags: Flags) -> int:
    """Play an agent, in a window, for a video, or unseen."""
    if flags.pretrained and not flags.given & {"env", "algo", "folder", "exp_id"}:
        from sb3_guard.zoo.agents.pretrained import listed

        print(f"{listed()}\n\nPlay one: sb3-guard enjoy --pretrained --env {flags.env}")
        return 0
    render_mode = "rgb_array" if flags.record is not None else None
    unseen = flags.no_render or (flags.dataset is not None and not flags.window)
    if render_mode is None and not unseen:
        display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        if flags.window or display or sys.platform != "linux":
            render_mode = "human"
        elif flags.verbose > 0:
            print("There is no display: nothing is shown. --record makes a video.", file=sys.stderr)

    from sb3_guard.zoo.agents.playback import play

    return play(flags, render_mode)


main = command(Flags, enjoy)

if __name__ == "__main__":
    sys.exit(main())
