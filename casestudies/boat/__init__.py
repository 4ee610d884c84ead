"""The boat of thesis 2.1.2.1 and chapter 4, which locates itself by distances and bearings to three beacons."""
