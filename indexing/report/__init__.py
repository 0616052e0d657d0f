"""Reports: pages, pictures, tables and manifests, written whole or not at all.

Importing this package loads neither matplotlib nor scikit-learn nor torch; they are imported when something is drawn or measured.
"""

from indexing.files import manifest, prepare, write_bytes, write_json, write_text
from indexing.report.recognition import write_recognition
from indexing.report.results import EvaluationResult, RecognitionReport, RecordingResult, ReportedEvent

__all__ = [
    "EvaluationResult",
    "RecognitionReport",
    "RecordingResult",
    "ReportedEvent",
    "manifest",
    "prepare",
    "write_bytes",
    "write_json",
    "write_recognition",
    "write_text",
]
