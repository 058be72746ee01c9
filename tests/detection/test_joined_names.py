from stream_dmr.detection.given_fish import joined


def test_few_names_are_all_said_and_of_many_the_first():
    assert joined([3, 1]) == "3, 1"
    assert joined([f"{n}.jpg" for n in range(8)]).endswith("6.jpg, 7.jpg")
    assert joined(range(20)).endswith("6, 7 and 12 more")
