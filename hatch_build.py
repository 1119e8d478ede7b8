"""The commit that a package is built from, in its file ``sb3_guard/COMMIT``."""

import subprocess
import tempfile

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

TRACKED = "git ls-files --error-unmatch hatch_build.py >/dev/null"
DESCRIBE = "git describe --always --dirty --abbrev=40 --exclude='*'"


class Commit(BuildHookInterface):
    def initialize(self, version: str, build_data: dict) -> None:
        git = subprocess.run(
            f"{TRACKED} && {DESCRIBE}", shell=True, cwd=self.root, capture_output=True
        )
        # An unpacked source distribution has its file already, and an editable package needs none.
        if git.returncode == 0 and version != "editable":
            self.file = tempfile.NamedTemporaryFile()  # it is removed with the hook
            self.file.write(git.stdout)
            self.file.flush()
            build_data["force_include"][self.file.name] = "sb3_guard/COMMIT"
