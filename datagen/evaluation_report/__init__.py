"""Inputs, tables and pages of `datagen evaluate`; the numbers come from train.evaluation."""
