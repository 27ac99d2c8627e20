"""Routes: analyses, results, gauges, exports, reports, previews."""
