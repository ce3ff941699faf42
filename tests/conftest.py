"""For all tests: the process is prepared as the command line prepares it, so that the kernels' cache is shared."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile

from hypothesis import settings

from services.common.process import prepare_process

prepare_process()

# what services keep over a restart must not reach the user's home, nor one run of the tests the next
os.environ.pop("STATE_DIRECTORY", None)
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="treedock-tests-state-")
atexit.register(shutil.rmtree, os.environ["XDG_STATE_HOME"], ignore_errors=True)

# The same examples on every machine, and no deadline: the first example compiles or loads a kernel.
settings.register_profile("treedock", derandomize=True, deadline=None)
settings.load_profile("treedock")
