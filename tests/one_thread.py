"""Has linear algebra run in one thread, as the program itself does (`rig.cli.main`).

The matrices of the tests are small: further threads wait for each other and keep busy processors
that other workers need. It is set before NumPy is imported, so this is imported first.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
