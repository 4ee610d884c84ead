"""A boat that locates itself by its distances and bearings to three beacons (thesis 2.1.2.1 and chapter 4)."""
