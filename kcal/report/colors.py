"""Colors of pictures and maps."""

from __future__ import annotations

INK, GRAY, FAINT, ACCENT, WARN = "#111827", "#4b5563", "#9aa3af", "#2b6cb0", "#c02a6b"
CAMERA_COLORS = ("#2b6cb0", "#dd7a1f", "#0f766e", "#7c3aed")
