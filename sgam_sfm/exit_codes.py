"""What a command tells the shell."""

DONE, ERROR, USAGE, SOME_FAILED, NO_MODEL, INTERRUPTED = 0, 1, 2, 3, 4, 130
MEANINGS = """exit codes: 0 done, 1 error, 2 usage, 3 done but some images or pairs failed (named in summary.json),
4 no model could be made, 130 stopped by Ctrl-C or SIGTERM"""
