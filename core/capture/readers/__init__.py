"""One module for each way that other tools write cameras."""
