"""The processes between a robot and its boards: subscriber, PCIe application, publisher."""
