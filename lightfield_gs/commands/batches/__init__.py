"""What `lightfield-gs batch` does with each item."""
