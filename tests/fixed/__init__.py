"""Runs whose outcome is kept as data: what a rewrite must not change.

Each file beside this one holds the decisions, costs, questions and values of one run, made by
commands alone, so that nothing here depends on how the code is laid out. `test_fixed.py` runs them
again and compares: text and whole numbers as they are, other numbers within 1e-9.

    python -m tests.fixed             runs all of them, and writes the files anew
    python -m tests.fixed discovery   one of them

A file is written anew only in a commit that means to change what it holds, and says why.
"""
