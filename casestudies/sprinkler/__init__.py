"""The sprinkler of thesis 2.1.3.1: has it rained, if the grass is wet? A BM2 answers with samples."""
