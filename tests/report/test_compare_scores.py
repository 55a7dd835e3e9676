from clsplat.report.compare import compare, final_table
from clsplat.report.groups import grouped
from tests.report.test_compare import trained


def test_scores_that_only_some_runs_have():
    def heads(*runs):
        return final_table(compare(grouped(runs))).head

    run = trained("a", schedule="sig")
    assert heads(run)[6:] == ("bytes", "PSNR cc, dB", "SSIM cc", "PSNR, dB", "SSIM")
    run.records[-1].update(flip=0.125, flip_cc=0.0625)
    assert heads(run)[8:] == ("SSIM cc", "FLIP cc", "PSNR, dB", "SSIM", "FLIP")
    groups = grouped([run, trained("b", schedule="dash")])
    assert [row[9::3] for row in final_table(compare(groups)).rows] == [
        ("0.0625", "0.1250"), ("-", "-")]
