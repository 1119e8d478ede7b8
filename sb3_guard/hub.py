"""Share trained agents on the Hugging Face hub: ``sb3-guard hub push --algo cpo …``."""

import sys

from sb3_guard.zoo.agents.flags import HubFlags as Flags
from sb3_guard.zoo.cli.flags import command


def hub(flags: Flags) -> int:
    """Upload an agent, or download one."""
    flags.check()

    from sb3_guard.zoo.agents import hub

    return hub.push(flags) if flags.direction == "push" else hub.load(flags)


main = command(Flags, hub)

if __name__ == "__main__":
    sys.exit(main())
