"""No text can break out of a page: values are escaped, as text and as JSON."""

from typing import Any

from stream_dmr.web.pages import render

EVIL = "</script><script>alert(1)</script>"


def page(title: str = EVIL, **data: Any) -> str:
    return render(
        "report/page.html",
        title=title,
        trip="",
        data=data,
        details=[(1, data)],
        plotly="report/keys.js",
        scripts=["keys.js"],
    )


def test_no_name_can_break_out_of_the_page():
    assert page(vessel=EVIL).count("<script") == page(vessel="").count("<script")
    assert page(vessel=EVIL).count("</script") == page(vessel="").count("</script")
    assert "alert(1)</script" not in page(vessel=EVIL)


def test_scripts_stand_in_the_page_as_they_are():
    assert "=> { const input = document.getElementById(id);" in page()


def test_a_name_that_is_no_utf_8_is_in_the_page_escaped():
    assert r"r\udce9" in page("r\udce9").encode().decode()
