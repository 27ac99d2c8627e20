"""Result files: fields, strain, gauges, summaries."""
