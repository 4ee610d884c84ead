"""The boat of thesis 2.1.2.1 and chapter 4: where am I, from distances and bearings to three beacons?"""
