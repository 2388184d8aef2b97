"""Imported last by the server that forks commands: their searches for garbage leave out its
libraries, whose memory they would otherwise copy."""

import gc

gc.freeze()
