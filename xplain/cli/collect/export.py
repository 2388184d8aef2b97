"""Labels, observers, and their codebook, from a collection's database that no server has open (or
from a snapshot).

    xplain collect export DATABASE FOLDER
"""

from functools import partial

from xplain.cli import people

main = partial(people.export, "collect")
