if __name__ != "datagen.train":  # a second name, from a checkout's folder, would define every class twice
    raise ImportError("import it as datagen.train")
