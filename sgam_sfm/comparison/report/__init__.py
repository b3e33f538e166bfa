"""The report of a comparison: one HTML file that opens without a network, see `write_report`."""

from sgam_sfm.comparison.report.bounds import Bounds
from sgam_sfm.comparison.report.writing import write_report

__all__ = ["Bounds", "write_report"]
