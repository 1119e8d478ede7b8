"""Export a trained agent: ``sb3-guard export --algo cpo --env Goal_Point_8Hazards``.

``sb3_guard.export`` is the function that exports a model, so the command's module has another name.
"""

import sys

from sb3_guard.zoo.agents.flags import ExportFlags as Flags
from sb3_guard.zoo.cli.flags import command


def export_agent(flags: Flags) -> int:
    """Write an agent's ONNX file and contract."""
    from sb3_guard.zoo.agents.export import export

    return export(flags)


main = command(Flags, export_agent)

if __name__ == "__main__":
    sys.exit(main())
