"""Parts of the reading of a load frame's record: its layout, the notation of its numbers, its clock."""
