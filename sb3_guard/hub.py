"""Share trained agents on the Hugging Face hub: ``sb3-guard hub push --algo cpo …``."""

import sys

from sb3_guard.zoo.agents.flags import HubFlags as Flags
from sb3_guard.zoo.cli.flags import command
from sb3_guard.zoo.cli.usage import UsageError


def hub(flags: Flags) -> int:
    """Upload an agent, or download one."""
    if flags.pretrained:
        raise UsageError("hub takes agents of your runs, not those of --pretrained")

    from sb3_guard.zoo.agents import hub

    return hub.push(flags) if flags.direction == "push" else hub.load(flags)


main = command(Flags, hub)

if __name__ == "__main__":
    sys.exit(main())
