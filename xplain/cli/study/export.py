"""CSV and Parquet tables, and their codebook, from a study's database that no server has open (or
from a snapshot).

    xplain study export DATABASE FOLDER
"""

from functools import partial

from xplain.cli import people

main = partial(people.export, "study")
