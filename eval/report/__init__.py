"""Reports: one account of an evaluation as HTML, Markdown, LaTeX, CSV and Parquet (`agentspec report`)."""

from eval.report.build import Report, build_report, write_files

__all__ = ["Report", "build_report", "write_files"]
