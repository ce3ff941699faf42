"""For all tests: the process is prepared as the command line prepares it, so that the kernels' cache is shared."""

from __future__ import annotations

from hypothesis import settings

from services.common.process import prepare_process

prepare_process()

# The same examples on every machine, and no deadline: the first example compiles or loads a kernel.
settings.register_profile("treedock", derandomize=True, deadline=None)
settings.load_profile("treedock")
