"""Writes docs/rig_file.md: every key of the rig file, from the model that reads it."""

from __future__ import annotations

from pathlib import Path

from server.config.reference import markdown

PAGE = Path(__file__).resolve().parents[3] / "docs" / "rig_file.md"

if __name__ == "__main__":
    PAGE.write_text(markdown(), encoding="utf-8")
