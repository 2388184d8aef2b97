"""Reference runs, stored as data: a rewrite must not change them.

Each file beside this one has the decisions, costs, questions and values of one run, made by
commands alone, so that they do not depend on the structure of the code. `test_fixed.py` runs them
again and compares: text and whole numbers as they are, other numbers within 1e-9.

    python -m tests.fixed             runs all of them, and writes the files anew
    python -m tests.fixed discovery   one of them

A file is written again only in a commit that changes its content on purpose, and says why.
"""
