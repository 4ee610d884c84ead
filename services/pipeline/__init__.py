"""The processes between a robot and its boards: subscriber, pcie-app and publisher."""
