"""`python -m sgam_sfm` is the command `sgam-sfm`."""

from sgam_sfm.runs.supervision import main

if __name__ == "__main__":
    main()
