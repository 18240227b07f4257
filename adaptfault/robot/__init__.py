"""What a deployed robot carries and does: the bundle, its versions, and the maintenance that replaces them."""
