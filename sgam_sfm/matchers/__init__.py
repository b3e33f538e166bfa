"""Point matchers, one adapter a file."""
