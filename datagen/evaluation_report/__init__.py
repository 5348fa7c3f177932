"""What `datagen evaluate` opens, tells and draws; the numbers come from train.evaluation."""
