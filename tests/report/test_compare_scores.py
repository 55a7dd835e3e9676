from clsplat.report.compare import compare, final_table
from clsplat.report.groups import grouped
from tests.report.test_compare import trained


def test_scores_that_only_some_runs_have():
    def heads(*runs):
        return final_table(compare(grouped(runs))).head

    run = trained("a", schedule="sig")
    assert heads(run)[3:8] == ("PSNR cc, dB", "PSNR, dB", "SSIM cc", "SSIM", "gaussians")
    run.records[-1].update(flip=0.125, flip_cc=0.0625)
    assert heads(run)[7:10] == ("FLIP cc", "FLIP", "gaussians")
    groups = grouped([run, trained("b", schedule="dash")])
    assert [row[7:9] for row in final_table(compare(groups)).rows] == [
        ("0.0625", "0.1250"), ("-", "-")]
