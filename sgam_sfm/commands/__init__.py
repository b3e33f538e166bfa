"""One file a command of `sgam-sfm`: its options, and `run(options, console) -> exit code`; heavy imports inside."""
