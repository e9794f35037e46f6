"""Files and web pages that a baked scene becomes."""
