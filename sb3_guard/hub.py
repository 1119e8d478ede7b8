"""Share trained agents on the Hugging Face hub: ``python -m sb3_guard.hub push --algo cpo …``."""

import sys

from sb3_guard.zoo.agent_flags import HubFlags as Flags
from sb3_guard.zoo.flags import command


def hub(flags: Flags) -> int:
    """Upload an agent, or download one."""
    flags.check()

    from sb3_guard.zoo import hub

    return hub.push(flags) if flags.direction == "push" else hub.load(flags)


main = command(Flags, hub)

if __name__ == "__main__":
    sys.exit(main())
