"""Where a viewer's eyes are: a camera with a face detector, or positions from elsewhere, steadied and foretold."""
