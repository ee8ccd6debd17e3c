"""`gift-peft prepare`: from a folder of photos to a checked dataset, with a report."""
