if __name__ != "datagen.train":  # in a checkout's folder the other name would make every class twice
    raise ImportError("import it as datagen.train")
